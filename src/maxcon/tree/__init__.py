"""The space that is searched: subsets as states, removals of basis points as actions (paper, sections 3.1 to 3.3)."""

from maxcon.tree.state import State, root

__all__ = ["State", "root"]
