"""What all pictures share: matplotlib where it is installed, one look, and colours that everyone can tell apart."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from matplotlib.figure import Figure

#: Okabe and Ito's palette (2008), made to be told apart with any kind of colour vision.
BLUE, VERMILLION, GREEN, SKY, ORANGE, PURPLE = (
    "#0072B2",
    "#D55E00",
    "#009E73",
    "#56B4E9",
    "#E69F00",
    "#CC79A7",
)
INK, GREY, PALE = "#222222", "#777777", "#DDDDDD"

#: For one method after another.
SERIES = (BLUE, VERMILLION, GREEN, PURPLE, ORANGE, SKY, GREY)

_LOOK = {
    "font.size": 9,
    "axes.titlesize": 10,
    "axes.titleweight": "bold",
    "axes.titlelocation": "left",
    "axes.labelsize": 9,
    "axes.edgecolor": GREY,
    "axes.labelcolor": INK,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.axisbelow": True,
    "axes.grid": True,
    "grid.color": "#ECECEC",
    "grid.linewidth": 0.7,
    "xtick.color": GREY,
    "ytick.color": GREY,
    "xtick.labelcolor": INK,
    "ytick.labelcolor": INK,
    "xtick.labelsize": 8,
    "ytick.labelsize": 8,
    "legend.fontsize": 8,
    "legend.frameon": True,
    "legend.framealpha": 0.9,
    "legend.edgecolor": PALE,
    "savefig.dpi": 150,
    "svg.hashsalt": "maxcon",
}

#: The keys of the dates that files would hold, so that equal pictures are equal files.
_NO_DATE = {"png": {}, "svg": {"Date": None}, "pdf": {"CreationDate": None}}


@contextmanager
def look() -> Iterator[None]:
    """Draw in the look of the package.

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed; the message says how to install it.
    """
    try:
        import matplotlib  # noqa: PLC0415  (only pictures need it)
    except ImportError:
        raise ModuleNotFoundError(
            "pictures need matplotlib, which is not installed: pip install 'maxcon[plot]'"
        ) from None
    with matplotlib.rc_context(_LOOK):  # type: ignore[arg-type]
        yield


def new_figure(width: float, height: float) -> Figure:
    """Return an empty figure of so many inches, laid out by constraints; to be called within `look`."""
    from matplotlib.figure import Figure  # noqa: PLC0415

    return Figure(figsize=(width, height), layout="constrained")


def picture(figure: Figure, kind: str) -> bytes:
    """Return the file of a figure; `kind` is "png", "svg" or "pdf"."""
    buffer = io.BytesIO()
    with look():
        figure.savefig(buffer, format=kind, metadata=_NO_DATE[kind])
    return buffer.getvalue()
