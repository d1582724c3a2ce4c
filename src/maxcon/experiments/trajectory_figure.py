"""Figure 1: the sets that A* visits and the path of the agent, on one small line problem."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING

import numpy as np

from maxcon.experiments.canvas import BLUE, GREEN, GREY, INK, PALE, VERMILLION, look, new_figure
from maxcon.experiments.contenders import AGENT, ASTAR, PAPER
from maxcon.experiments.records import Run
from maxcon.problem import LinearProblem

if TYPE_CHECKING:
    from matplotlib.axes import Axes
    from matplotlib.figure import Figure


def walker(records: Sequence[Run]) -> str | None:
    """Return the agent that is shown: the shipped one, else the paper's; None where there is neither."""
    return next((name for name in (AGENT, PAPER) if any(each.name == name and each.done for each in records)), None)


def chosen_unit(records: Sequence[Run]) -> str | None:
    """Return the problem that is shown.

    Of those on which the agent's walk ends in the optimum, as in the paper's figure, the one on which A* expands a
    median number of sets; None where there is none.
    """
    name = walker(records)
    ended = {each.unit for each in records if each.name == name and each.before_refinement == each.best}
    rows = [each for each in records if each.name == ASTAR and each.done and each.unit in ended]
    ordered = sorted((len(each.measures["expanded"]), each.unit) for each in rows)
    return ordered[len(ordered) // 2][1] if ordered else None


def draw_trajectory(records: Sequence[Run], unit: str, problem: LinearProblem) -> Figure:
    """Return the figure: the points, the tree of A* and the path of the agent.

    Parameters
    ----------
    records
        Of the experiment "trajectory".
    unit, problem
        From `chosen_unit`, and its problem.

    Raises
    ------
    ModuleNotFoundError
        If matplotlib is not installed.
    """
    name = walker(records)
    rows = {each.name: each for each in records if each.unit == unit}
    search, agent = rows[ASTAR], rows[str(name)]
    with look():
        figure = new_figure(14.0, 7.0)
        points, tree, path = figure.subplots(1, 3, width_ratios=(1.0, 1.35, 0.45))
        _points(points, problem, search)
        _tree(tree, search)
        _path(path, agent, len(_goal_path(search)))
        figure.suptitle(
            f"A* and the agent on a line problem, N = {search.n_points}, {search.rate}% outliers, {search.instance}",
            x=0.01,
            ha="left",
            fontweight="bold",
        )
        _legend(figure)
    return figure


def _points(axes: Axes, problem: LinearProblem, search: Run) -> None:
    x, y = problem.A[:, 0], problem.b
    out = np.zeros(len(x), dtype=np.bool_)
    out[search.measures["outliers"]] = True
    axes.plot(x[~out], y[~out], "o", color=BLUE, markersize=4)
    axes.plot(x[out], y[out], "X", color=VERMILLION, markersize=6)
    for i in np.flatnonzero(out):
        axes.annotate(str(i), (x[i], y[i]), xytext=(5, 3), textcoords="offset points", fontsize=8, color=INK)
    axes.set(title=f"the points; {out.sum()} outliers, numbered", xlabel="x", ylabel="y")


def _goal_path(search: Run) -> list[int]:
    """Return the numbers of the sets from the root to the one that A* ended with."""
    nodes, node = search.measures["nodes"], search.measures["expanded"][-1]
    path = [node]
    while nodes[path[-1]][0] >= 0:
        path.append(nodes[path[-1]][0])
    return path[::-1]


def _tree(axes: Axes, search: Run) -> None:
    """Draw all sets that A* made, one row a level: on the way to the optimum, expanded in vain, or only made."""
    nodes, expanded = search.measures["nodes"], set(search.measures["expanded"])
    goal = _goal_path(search)
    on_goal = set(goal)
    children: dict[int, list[int]] = {}
    for node, (parent, _) in enumerate(nodes):
        children.setdefault(parent, []).append(node)
    place, level = _layout(children, on_goal)
    size = float(np.clip(60.0 / np.sqrt(len(nodes)), 4.5, 8.0))
    for node, (parent, _) in enumerate(nodes):
        if parent < 0:
            continue
        colour, width = _edge(node, on_goal, expanded)
        axes.plot(
            [place[parent], place[node]],
            [-level[parent], -level[node]],
            color=colour,
            linewidth=width,
            zorder=3 if node in on_goal else 2,
        )
    for node, (_, point) in enumerate(nodes):
        colour, _ = _edge(node, on_goal, expanded)
        shown = node in expanded
        axes.text(
            place[node],
            -level[node],
            "all" if point < 0 else str(point),
            ha="center",
            va="center",
            fontsize=size if shown else 0.8 * size,
            color="white" if shown else GREY,
            zorder=5,
            bbox={
                "boxstyle": "circle,pad=0.18",
                "facecolor": colour if shown else "white",
                "edgecolor": colour,
                "linewidth": 0.6,
            },
        )
    in_vain = len(expanded - on_goal)
    axes.set_xlim(min(place.values()) - 1, max(place.values()) + 1)
    axes.set_ylim(-max(level.values()) - 0.6, 0.6)
    axes.axis("off")
    axes.set_title(f"A*: {len(nodes)} sets made, {len(expanded)} expanded, {in_vain} of them off the way")


def _edge(node: int, on_goal: set[int], expanded: set[int]) -> tuple[str, float]:
    if node in on_goal:
        return VERMILLION, 1.8
    return (GREEN, 1.3) if node in expanded else (PALE, 0.7)


def _layout(children: dict[int, list[int]], on_goal: set[int]) -> tuple[dict[int, float], dict[int, int]]:
    """Return the place and the level of every set: leaves side by side, parents over the middle of their children."""
    place: dict[int, float] = {}
    level: dict[int, int] = {}
    free = 0.0

    def visit(node: int, depth: int) -> float:
        nonlocal free
        level[node] = depth
        below = sorted(children.get(node, []), key=lambda child: (child not in on_goal, child))
        if not below:
            place[node] = free
            free += 1.0
        else:
            where = [visit(child, depth + 1) for child in below]
            place[node] = 0.5 * (where[0] + where[-1])
        return place[node]

    visit(0, 0)
    return place, level


def _path(axes: Axes, agent: Run, n_levels: int) -> None:
    path = agent.measures["path"]
    axes.plot([0] * (len(path) + 1), -np.arange(len(path) + 1), color=VERMILLION, linewidth=1.8, zorder=2)
    for depth, point in enumerate([-1, *path]):
        axes.text(
            0,
            -depth,
            "all" if point < 0 else str(point),
            ha="center",
            va="center",
            fontsize=8,
            color="white",
            zorder=5,
            bbox={"boxstyle": "circle,pad=0.22", "facecolor": VERMILLION, "edgecolor": VERMILLION},
        )
    axes.set_xlim(-1, 1)
    axes.set_ylim(-max(len(path), n_levels - 1) - 0.6, 0.6)
    axes.axis("off")
    axes.set_title(f"{agent.name}: {len(path)} steps", loc="center")


def _legend(figure: Figure) -> None:
    from matplotlib.lines import Line2D  # noqa: PLC0415  (only pictures need it)

    figure.legend(
        [Line2D([], [], color=colour, linewidth=2) for colour in (VERMILLION, GREEN, PALE)],
        ["from all points to the optimum", "expanded by A* off that way", "made by A*, not expanded"],
        loc="outside lower left",
        ncols=3,
        frameon=False,
        title="each circle is a set of points; the number is that of the point removed to reach it",
        title_fontsize=7.5,
        alignment="left",
    )
