"""f(S) and B(S), the engine under everything."""

from maxcon.minimax.fit import MinimaxFit, minimax_fit
from maxcon.minimax.rank import rank_holds
from maxcon.minimax.rows import LinearRows, linear_rows
from maxcon.minimax.workspace import Workspace, allocate

__all__ = ["LinearRows", "MinimaxFit", "Workspace", "allocate", "linear_rows", "minimax_fit", "rank_holds"]
