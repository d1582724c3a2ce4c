"""``maxcon fit-pair``: from two images to their fundamental matrix and the matches that it explains."""

from __future__ import annotations

import io
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

import click
import numpy as np
from numba.core.event import install_recorder
from numpy.typing import NDArray
from rich.table import Table
from rich.text import Text

from maxcon.cli import INTERRUPTED
from maxcon.cli.errors import Failure, reported
from maxcon.cli.fit import check_certificate, check_options, parse_options, write_proof
from maxcon.cli.interrupt import noticed
from maxcon.cli.options import search_options
from maxcon.cli.output import PICTURES, check_matplotlib, check_output, write_output
from maxcon.cli.present import REFINED_BY, borderless, consensus_json, console, duration, number, proof

if TYPE_CHECKING:
    from maxcon.vision import FundamentalFit

#: Those of `maxcon.vision.CHARTS`, here so that --help need not load the engine.
_CHARTS = ("auto", "F32=1", "F33=1")

#: `maxcon.vision.fundamental.USUAL_THRESHOLD`, here for the same reason.
_THRESHOLD = 0.01

#: Of the polish, as in `maxcon.find_fundamental`.
_PIXELS = 1.0


@dataclass(frozen=True, eq=False)
class Pair:
    """Matches of two images, and the images where there are any."""

    names: tuple[str, ...]
    x1: NDArray[np.float64]
    x2: NDArray[np.float64]
    image1: NDArray[np.uint8] | None
    image2: NDArray[np.uint8] | None
    origin: str


@click.command(name="fit-pair", short_help="Fit the fundamental matrix of two images.")
@click.argument("files", nargs=-1, metavar="IMAGE1 IMAGE2 | PAIR.mat")
@click.option(
    "--threshold",
    type=float,
    default=_THRESHOLD,
    show_default=True,
    metavar="E",
    help="The largest residual of an inlier: algebraic, in normalised coordinates, without a unit.",
)
@click.option(
    "--chart",
    type=click.Choice(_CHARTS),
    default="auto",
    show_default=True,
    help="How the scale of F is fixed: near a robust estimate, or by an entry of it that is made 1.",
)
@click.option(
    "--pixels",
    type=float,
    default=_PIXELS,
    show_default=True,
    metavar="P",
    help="Polish F to have many matches within so many pixels (Sampson); 0 leaves it as the consensus has it.",
)
@search_options
@click.option(
    "--certificate",
    metavar="OUT",
    help="Write a certificate (JSON), which `maxcon verify` checks against --rows; implies --certify.",
)
@click.option("--rows", "rows_out", metavar="OUT", help="Write the linear problem as .npy: a match a row, A beside b.")
@click.option(
    "--ratio",
    type=float,
    default=0.8,
    show_default=True,
    help="Of images: how much nearer than the second nearest a SIFT descriptor must be to be matched.",
)
@click.option("--json", "json_out", metavar="OUT", help="Write the result as JSON; - is standard output.")
@click.option(
    "--picture",
    "picture_out",
    metavar="OUT",
    help="Draw the matches as .png, .svg or .pdf; - writes a PNG to standard output.",
)
def command(
    files: tuple[str, ...],
    threshold: float,
    chart: str,
    pixels: float,
    method: str,
    refine: str,
    seed: int,
    time_limit: float | None,
    gap: int,
    certify: bool,
    certificate: str | None,
    rows_out: str | None,
    options: tuple[str, ...],
    ratio: float,
    json_out: str | None,
    picture_out: str | None,
) -> None:
    """Fit the fundamental matrix of IMAGE1 and IMAGE2, despite the wrong ones among their matches.

    The images are matched by SIFT (nearest descriptors by the ratio test, mutual), the matches normalised, and
    the linearised F is found that explains as many of them as possible within the threshold: the consensus, with
    its bound. From there F is brought to rank 2 and polished, to have as many matches as local optimisation finds
    within --pixels; no bound holds for these. One MATLAB file PAIR.mat (a struct "data" with matches.X1 and
    matches.X2, as the authors of A*-NAPA-DIBP published) stands for matches and images.

    The JSON object holds the files, the chart, F (3x3, pixels, [x2, 1] F [x1, 1] = 0), F_linear (before the
    polish), the matches x1 and x2, their Sampson distances from F in pixels, which of them are within --pixels, a
    note where the inliers do not determine F (of one plane, or the camera has only turned), else null, and every
    field of maxcon.Consensus; model, residuals, inlier_mask and threshold are those of the linear problem.

    \b
    Examples:
      maxcon fit-pair left.png right.png --picture matches.png
      maxcon fit-pair 000000.png 000003.png --chart F32=1 --threshold 0.03 --time-limit 10
      maxcon fit-pair KITTI_417_420.mat --json - | jq .F
      maxcon fit-pair KITTI_417_420.mat --certificate pair.cert.json --rows pair.npy
      maxcon verify pair.cert.json pair.npy
    """
    if json_out == "-" and picture_out == "-":
        raise Failure("--json and --picture cannot both go to standard output")
    chosen = parse_options(options)
    check_options(method, chosen)
    check_certificate(certificate)
    if rows_out is not None:
        check_output(rows_out, "--rows", (".npy",))
    if json_out is not None:
        check_output(json_out, "--json")
    if picture_out is not None:
        check_output(picture_out, "--picture", PICTURES)
        check_matplotlib()
    pair = read_pair(files, ratio)
    refiner = None if refine == "none" else refine
    with noticed() as interrupted, install_recorder("numba:compile") as compilations:
        found = _fit(
            pair,
            threshold,
            {
                "chart": chart,
                "pixels": pixels or None,
                "method": method,
                "rng": seed,
                "time_limit": time_limit,
                "refine": refiner,
                "gap": gap,
            }
            | {"certify": certify or certificate is not None}
            | chosen,
        )
        linear = found.problem.problem
        claimed = None if certificate is None else write_proof(certificate, linear, found.consensus)
    if rows_out is not None:
        content = io.BytesIO()
        np.save(content, np.column_stack([linear.A, linear.b]))
        write_output(rows_out, content.getvalue())
    if picture_out is not None:
        write_output(picture_out, _picture(pair, found, picture_out))
    if json_out is not None:
        write_output(json_out, _json(pair, found))
    if "-" not in (json_out, picture_out):
        notes = ["compiling not counted"] * bool(compilations.buffer) + ["stopped by Ctrl-C"] * interrupted.is_set()
        out = console()
        out.print(Text(f"fundamental matrix of {' and '.join(pair.names)}, threshold {threshold:g}", style="bold"))
        out.print(pair_table(pair, found, refiner, notes))
        for name in (json_out, picture_out, rows_out):
            if name is not None:
                click.echo(f"wrote {name}")
        if claimed is not None:
            click.echo(f"wrote {certificate}: {claimed}")
    if interrupted.is_set():
        click.get_current_context().exit(INTERRUPTED)


def read_pair(files: tuple[str, ...], ratio: float) -> Pair:
    """Return the matches of two image files, or of one MATLAB file; Failure where that cannot be done."""
    from maxcon.datasets import load_mat  # noqa: PLC0415
    from maxcon.vision import match_images, read_image  # noqa: PLC0415
    from maxcon.vision.fundamental import LEAST_MATCHES  # noqa: PLC0415

    try:
        with reported():
            if len(files) == 1 and files[0].lower().endswith(".mat"):
                table = load_mat(files[0])
                pair = Pair(files, table.x1, table.x2, table.image1, table.image2, "from the file")
            elif len(files) == 2:
                image1, image2 = read_image(files[0]), read_image(files[1])
                matches = match_images(image1, image2, ratio=ratio)
                origin = "of {} and {} SIFT keypoints".format(*matches.n_keypoints)
                pair = Pair(files, matches.x1, matches.x2, image1, image2, origin)
            else:
                raise Failure(f"give two images, or one .mat file, but there are {len(files)} files: {list(files)}")
    except OSError as error:
        raise Failure(f"cannot read {error.filename!r}: {error.strerror}") from None
    if len(pair.x1) < LEAST_MATCHES:
        raise Failure(
            f"a fundamental matrix needs at least {LEAST_MATCHES} matches, but {' and '.join(files)} have "
            f"{len(pair.x1)} ({pair.origin}); a higher --ratio lets more pass"
        )
    return pair


def pair_table(pair: Pair, found: FundamentalFit, refine: str | None, notes: list[str]) -> Table:
    """Return what `maxcon fit-pair` shows; `notes` are remarks on the time."""
    consensus = found.consensus
    N = len(pair.x1)
    table = borderless()
    table.add_row("matches", f"{N} ({pair.origin})")
    table.add_row("inliers", f"{consensus.n_inliers} of {N} ({consensus.n_inliers / N:.1%})")
    table.add_row("bound", f"at most {consensus.upper_bound} are possible in this chart")
    table.add_row("proof", proof(consensus))
    table.add_row("chart", found.chart)
    if consensus.status == "optimal" or refine is None:
        table.add_row("method", consensus.method)
    else:
        table.add_row("method", f"{consensus.method}, then {REFINED_BY[refine]}")
    table.add_row("time", ", ".join([duration(consensus.seconds), *notes]))
    if found.degeneracy.note is not None:
        table.add_row("note", Text(found.degeneracy.note, style="yellow"))
    if np.isfinite(found.F).all():
        table.add_row("Sampson", f"median {number(found.median_sampson)} pixels (linear inliers, from F)")
        if found.pixels is not None:
            near = np.count_nonzero(found.within())
            table.add_row("polished", f"{near} of {N} ({near / N:.1%}) within {found.pixels:g} px of F (Sampson)")
        rows = ["  ".join(f"{value:12.5e}" for value in row) for row in found.F]
        table.add_row("F (pixels)", Text("\n".join(rows)))
    else:
        table.add_row("F (pixels)", "none")
    return table


def _fit(pair: Pair, threshold: float, settings: dict[str, Any]) -> FundamentalFit:
    """Fit, showing on a terminal how far it is."""
    from maxcon.vision import find_fundamental  # noqa: PLC0415

    with console(stderr=True).status("fitting ...") as status:

        def show(progress: Any) -> None:
            status.update(f"fitting: {progress.n_inliers} inliers found, at most {progress.upper_bound} possible")

        with reported():
            return find_fundamental(pair.x1, pair.x2, threshold, callback=show, **settings)


def _json(pair: Pair, found: FundamentalFit) -> bytes:
    about = {
        "files": list(pair.names),
        "chart": found.chart,
        "F": found.F,
        "F_linear": found.F_linear,
        "pixels": found.pixels,
        "within_pixels": None if found.pixels is None else found.within(),
        "median_sampson": found.median_sampson,
        "note": found.degeneracy.note,
        "x1": pair.x1,
        "x2": pair.x2,
        "sampson": found.sampson,
    }
    return consensus_json(found.consensus, about)


def _picture(pair: Pair, found: FundamentalFit, out: str) -> bytes:
    from maxcon.cli.pair_picture import draw_matches  # noqa: PLC0415
    from maxcon.experiments.canvas import picture  # noqa: PLC0415

    names = [Path(name).name for name in pair.names]
    kind = "png" if out == "-" else Path(out).suffix[1:].lower()
    figure = draw_matches(
        pair.x1, pair.x2, found.inlier_mask, pair.image1, pair.image2, " and ".join(names), caption(found)
    )
    return picture(figure, kind)


def caption(found: FundamentalFit) -> str:
    """Return the result in one line."""
    from maxcon.cli.picture import numbers  # noqa: PLC0415

    text = numbers(found.consensus).replace("points", "matches")
    if np.isfinite(found.F).all():
        text += f"; chart {found.chart}; median Sampson distance {found.median_sampson:.2f} px"
    return text
