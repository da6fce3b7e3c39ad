"""A map of a network for people: where its points are, how good they are, and how tiles and images lie."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import shapely
from matplotlib.artist import Artist
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from submin import Network
from submin.errors import InputError
from submin.formats.replacing import replacing
from submin.sensors import SURVEYS
from submin.storage.accuracy_map import PointAccuracy
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Box = tuple[float, float, float, float]

DOTS_PER_INCH = 160
METRES_BELOW = 5000.0
"""Maps of a smaller extent are in metres, others in kilometres; so are lengths in the heading."""
ROBUST = (2.0, 98.0)
"""Percentiles at which the colours end."""
INK = 0.16
"""Part of a map that its points would cover if they lay apart."""
NARROWEST = np.array([0.4, 0.25])
"""Least width over height, and height over width, of a map."""
WIDE = 1.8
"""A map of a larger width over height has the other panels below it."""
RIMMED = 4.0
"""Points larger than this (square points of print) get a thin rim, which keeps neighbours apart."""
NAMED_INCHES = 0.7
"""Cores of at least this width on the map carry the name of their tile."""
LETTERS_AN_INCH = 11.0
LONGEST_ID = 40

PAPER, GROUND, DARK, SOFT, RULE = "#ffffff", "#f7f8fa", "#1f2933", "#616e7c", "#cbd2d9"
CORE, TILE, IMAGE, COVERED, FLAGGED = "#3e4c59", "#7b8794", "#4a7fb5", "#a9c5e3", "#d7263d"
DASHES = (0, (5, 4))
HORIZONTAL, VERTICAL = "#3a0ca3", "#e07a1f"

# plasma without its light end, which is lost on paper; a part of a perceptually uniform map is one too
COLOURS = ListedColormap(matplotlib.colormaps["plasma"](np.linspace(0.0, 0.9, 256)))


@dataclass(frozen=True)
class _View:
    """Window of a map in the plane (west, south, east, north, in units), and the unit: its name and its metres."""

    box: Box
    unit: str
    metres: float

    @property
    def aspect(self) -> float:
        """Width over height."""
        west, south, east, north = self.box
        return (east - west) / (north - south)

    def holds(self, place: Array) -> NDArray[np.bool_]:
        """True (n,) for places (n, 2), in units, inside the window."""
        west, south, east, north = self.box
        return np.asarray((place[:, 0] >= west) & (place[:, 0] <= east) & (place[:, 1] >= south) & (place[:, 1] <= north))


@dataclass(frozen=True)
class _Layout:
    """Places on the page in inches, from the bottom left: width and height of the page, and left, bottom, width, height of its parts."""

    page: tuple[float, float]
    main: Box
    main_bar: Box
    small: Box
    small_bar: Box
    histogram: Box


@dataclass(frozen=True)
class _Images:
    """Number of images, ids of the flagged ones, and the outlines (k, 2) of footprints in plane metres: of all, and of the flagged."""

    count: int
    flagged_ids: list[str]
    outlines: list[Array]
    flagged_outlines: list[Array]


def draw_network(network: Network, path: str | Path, *, title: str | None = None) -> None:
    """Draw a network as PNG: points by CE90 and by LE90, cores and tiles, footprints, and the images whose camera was found to be bad.

    The map is in the equal-area plane of the cover, kilometres from its centre (metres where it spans less than 5 km). Colours end at the
    2nd and the 98th percentile. The accuracy of a point is that of the tile whose core holds it; no joint covariance is formed.

    Parameters
    ----------
    network : Network
    path : file to write, ``.png``
    title : heading; default: name and version of the network

    Raises
    ------
    InputError
        When the name does not end in ``.png`` or the folder does not exist.
    """
    target = Path(path)
    if target.suffix.lower() != ".png":
        raise InputError(f"{target}: a map is written as PNG; expected a name that ends in .png")
    figure = network_figure(network, title)
    # without the name and version of the program the same network gives the same file
    with replacing(target) as temporary:
        figure.savefig(temporary, format="png", dpi=DOTS_PER_INCH, facecolor=PAPER, metadata={"Software": None})


def network_figure(network: Network, title: str | None = None) -> Figure:
    """The figure that `draw_network` writes, on a canvas of its own: nothing of matplotlib's global state is used."""
    cover, points, images = network.cover, network.accuracy(), _images(network)
    plane = np.column_stack(cover.plane(points.geodetic[:, 0], points.geodetic[:, 1])) if len(points) else np.empty((0, 2))
    view = _view(cover, plane)
    place = plane / view.metres
    layout = _layout(view.aspect)
    figure = Figure(figsize=layout.page, facecolor=PAPER)
    FigureCanvasAgg(figure)

    main, small = _axes(figure, layout, layout.main), _axes(figure, layout, layout.small)
    for axes, values, bar, label, box in (
        (main, points.ce90, layout.main_bar, "CE90 (m)", layout.main),
        (small, points.le90, layout.small_bar, "LE90 (m)", layout.small),
    ):
        _draw_cores(axes, cover, view, box[2])
        if len(points):
            scatter = _draw_points(axes, place, values, box)
            _draw_bar(figure, _axes(figure, layout, bar), scatter, values, label)
    _draw_footprints(main, view, images)
    _draw_tiles(main, cover, view, layout.main[2])
    _label_axes(main, cover, view)
    if not len(points):
        main.text(0.5, 0.5, "no determined points yet", transform=main.transAxes, ha="center", va="center", color=SOFT, fontsize=13)
    main.set_title("Horizontal accuracy of each point, from the tile whose core holds it", loc="left", fontsize=9, color=DARK)
    small.set_title("Vertical accuracy", loc="left", fontsize=9, color=DARK)
    small.set(xticks=[], yticks=[])
    _draw_histogram(_axes(figure, layout, layout.histogram), points)
    _draw_legend(figure, layout, cover, images, int((~view.holds(place)).sum()))
    _draw_heading(figure, layout, network, points, images, title)
    return figure


def _images(network: Network) -> _Images:
    columns = network.snapshot.image_columns(["image_id", "sensor", "footprint", "released", "withdrawn"])
    here = (columns["withdrawn"] == 0) & ~np.isin(columns["sensor"], SURVEYS)  # views of control points are no images
    columns = {name: values[here] for name, values in columns.items()}
    flagged = columns["released"] == 1
    given = np.flatnonzero(columns["footprint"] != "")
    parts, image = shapely.get_parts(shapely.from_wkb(columns["footprint"][given], on_invalid="ignore"), return_index=True)
    corners, part = shapely.get_coordinates(shapely.get_exterior_ring(parts), return_index=True)
    # sides are straight in the plane, so a footprint may cross the antimeridian
    plane = np.column_stack(network.cover.plane(corners[:, 0], corners[:, 1]))
    outlines = {int(k): outline for k, outline in _groups(part, plane) if np.isfinite(outline).all()}
    bad = [outline for k, outline in outlines.items() if flagged[given[image[k]]]]
    return _Images(len(flagged), columns["image_id"][flagged].tolist(), list(outlines.values()), bad)


def _groups(keys: NDArray[np.integer], values: Array) -> Iterator[tuple[int, Array]]:
    """Values of each key, where equal keys stand together."""
    first = np.flatnonzero(np.diff(keys, prepend=-1))
    return zip(keys[first].tolist(), np.split(values, first[1:]), strict=False) if len(first) else iter(())


def _view(cover: Cover, plane: Array) -> _View:
    """All tiles and points; but of points outside the area only those that are no further than a core, lest one of them shrink the map."""
    half = 0.5 * cover.overlap
    low = np.asarray(cover.origin) - half
    high = np.asarray(cover.origin) + cover.core * np.array([cover.columns, cover.rows]) + half
    if len(plane):
        low = np.maximum(np.minimum(low, plane.min(axis=0)), low - cover.core)
        high = np.minimum(np.maximum(high, plane.max(axis=0)), high + cover.core)
    middle, size = 0.5 * (low + high), 1.04 * (high - low)
    size = np.maximum(size, size[::-1] * NARROWEST)
    unit, metres = _unit(float(size.max()))
    west, south = (middle - 0.5 * size) / metres
    east, north = (middle + 0.5 * size) / metres
    return _View((float(west), float(south), float(east), float(north)), unit, metres)


def _unit(length: float) -> tuple[str, float]:
    """The unit in which to write lengths up to this one, metres: its name and its metres."""
    return ("m", 1.0) if length < METRES_BELOW else ("km", 1000.0)


def _layout(aspect: float) -> _Layout:
    """The small map and the histogram beside the large map, or below it when it is wide."""
    left, below, above, bar, label, gap = 0.95, 1.35, 1.2, 0.16, 0.95, 0.8
    if aspect <= WIDE:
        width = min(8.0, 7.2 * aspect)
        height = width / aspect
        tall, column = max(height, 5.6), 2.9
        small_width = min(column, 3.1 * aspect)
        small_height = small_width / aspect
        x, top = left + width + label + 0.6, below + tall
        small = (x, top - small_height, small_width, small_height)
        histogram = (x, below, column, tall - small_height - gap)
        page_width = x + column + label
    else:
        width, row = 11.0, 2.6
        height = width / aspect
        small_width = min(0.45 * width, row * aspect)
        small_height = small_width / aspect
        x, top = left + small_width + label + 0.75, below + row + gap + 0.2 + height
        small = (left, below + row - small_height, small_width, small_height)
        histogram = (x, below, left + width - x, row)
        page_width = left + width + label
    main = (left, top - height, width, height)
    return _Layout(
        (page_width, top + above),
        main, (left + width + 0.18, main[1], bar, height),
        small, (small[0] + small_width + 0.14, small[1], 0.7 * bar, small_height),
        histogram,
    )  # fmt: skip


def _axes(figure: Figure, layout: _Layout, box: Box) -> Axes:
    width, height = layout.page
    axes = figure.add_axes((box[0] / width, box[1] / height, box[2] / width, box[3] / height))
    axes.tick_params(colors=SOFT, labelsize=8, length=3, width=0.6)
    for spine in axes.spines.values():
        spine.set(color=RULE, linewidth=0.8)
    return axes


def _draw_cores(axes: Axes, cover: Cover, view: _View, width: float) -> None:
    """Window and borders of cores, as a map so many inches wide has them."""
    west, south, east, north = view.box
    axes.set(xlim=(west, east), ylim=(south, north), facecolor=GROUND, aspect="equal")
    core = _inches(cover.core, view, width)
    lines = LineCollection(
        [*_grid(*_borders(cover, view)), *_crosses(cover, view)], colors=CORE, linewidths=float(np.clip(core, 0.15, 0.9)), zorder=2.1
    )
    axes.add_collection(lines, autolim=False)


def _draw_tiles(axes: Axes, cover: Cover, view: _View, width: float) -> None:
    """Outlines of tiles, and where there is room for them their names."""
    half, core = 0.5 * cover.overlap / view.metres, _inches(cover.core, view, width)
    if half > 0.0:
        x, y = _borders(cover, view)
        # a tile reaches over the borders of its core; beyond the rim there is no neighbour that reaches back
        sides = _grid(np.concatenate([x[:-1] - half, x[1:] + half]), np.concatenate([y[:-1] - half, y[1:] + half]))
        quarters = [q for tile in cover.splits for q in cover.quarters(tile) if q not in cover.splits]
        sides += [cover.tile_outline(quarter) / view.metres for quarter in quarters]
        lines = LineCollection(sides, colors=TILE, linewidths=float(np.clip(0.7 * core, 0.15, 0.6)), alpha=0.65, zorder=2)
        lines.set_linestyle([DASHES])
        axes.add_collection(lines, autolim=False)
    if core < NAMED_INCHES:
        return
    for tile in cover.tiles():
        west, north = cover.core_outline(tile)[3] / view.metres
        axes.annotate(
            cover.tile_name(tile), (west, north), xytext=(4, -4), textcoords="offset points", ha="left", va="top", fontsize=6.5,
            color=SOFT, zorder=5, path_effects=[withStroke(linewidth=2.0, foreground=GROUND)],
        )  # fmt: skip


def _borders(cover: Cover, view: _View) -> tuple[Array, Array]:
    """Eastings and northings of the borders of cores, in units."""
    return (
        np.asarray(cover.origin[0] + cover.core * np.arange(cover.columns + 1.0)) / view.metres,
        np.asarray(cover.origin[1] + cover.core * np.arange(cover.rows + 1.0)) / view.metres,
    )


def _crosses(cover: Cover, view: _View) -> list[Array]:
    """Lines that cut split cores into quarters, in units."""
    crosses = []
    for tile in cover.splits:
        outline = cover.core_outline(tile) / view.metres
        (west, south), (east, north) = outline.min(axis=0), outline.max(axis=0)
        x, y = 0.5 * (west + east), 0.5 * (south + north)
        crosses += [np.array([[x, south], [x, north]]), np.array([[west, y], [east, y]])]
    return crosses


def _inches(length: float, view: _View, width: float) -> float:
    """Length, in metres, as it is on a map so many inches wide."""
    return length / view.metres / (view.box[2] - view.box[0]) * width


def _grid(x: Array, y: Array) -> list[Array]:
    """Lines along every x over the whole of y, and along every y over the whole of x."""
    return [np.array([[v, y.min()], [v, y.max()]]) for v in x] + [np.array([[x.min(), v], [x.max(), v]]) for v in y]


def _draw_footprints(axes: Axes, view: _View, images: _Images) -> None:
    """All of them lightly, so that coverage shows; the flagged ones in red."""
    outlines, flagged = ([outline / view.metres for outline in some] for some in (images.outlines, images.flagged_outlines))
    if outlines:
        corners = np.concatenate(outlines)
        low = np.maximum(corners.min(axis=0), view.box[:2])
        high = np.minimum(corners.max(axis=0), view.box[2:])
        covered = float(shapely.area([shapely.Polygon(outline) for outline in outlines]).sum())
        depth = max(covered / max(float(np.prod(high - low)), 1e-9), 1.0)
        # places of average coverage become half as blue as can be; fainter films than 0.025 are lost in eight bits
        face = max(1.0 - 0.5 ** (1.0 / depth), 0.025)
        edge = float(np.clip(12.0 / np.sqrt(len(outlines)), 0.08, 0.45))
        axes.add_collection(PolyCollection(outlines, facecolors=[(COVERED, face)], edgecolors="none", zorder=1), autolim=False)
        axes.add_collection(
            PolyCollection(outlines, facecolors="none", edgecolors=[(IMAGE, edge)], linewidths=0.5, zorder=1.1), autolim=False
        )
    if flagged:
        halo = [withStroke(linewidth=3.2, foreground=PAPER)]
        red = PolyCollection(flagged, facecolors="none", edgecolors=FLAGGED, linewidths=1.6, zorder=4, path_effects=halo)
        axes.add_collection(red, autolim=False)


def _draw_points(axes: Axes, place: Array, values: Array, box: Box) -> PathCollection:
    # shuffled: where points hide each other, no value is favoured
    order = np.random.default_rng(0).permutation(len(values))
    size = float(np.clip(INK * box[2] * box[3] * 72.0**2 / len(values), 0.5, 26.0))
    return axes.scatter(
        place[order, 0], place[order, 1], c=values[order], s=size, cmap=COLOURS, norm=Normalize(*_limits(values)), edgecolors=PAPER,
        linewidths=0.3 if size > RIMMED else 0.0, rasterized=True, zorder=3,
    )  # fmt: skip


def _limits(values: Array) -> tuple[float, float]:
    """Ends of the colours: robust, and apart."""
    low, high = (float(v) for v in np.percentile(values, ROBUST))
    least = max(0.02 * abs(high), 1e-6)
    middle = 0.5 * (low + high)
    return (low, high) if high - low >= least else (max(middle - 0.5 * least, 0.0), middle + 0.5 * least)


def _draw_bar(figure: Figure, axes: Axes, scatter: PathCollection, values: Array, label: str) -> None:
    low, high = _limits(values)
    beyond = {(False, False): "neither", (True, False): "min", (False, True): "max", (True, True): "both"}
    extend = beyond[bool(values.min() < low), bool(values.max() > high)]
    bar = figure.colorbar(scatter, cax=axes, extend=extend, extendfrac=0.025)
    bar.outline.set(linewidth=0.0)
    bar.locator = MaxNLocator(6)
    bar.update_ticks()
    axes.tick_params(colors=SOFT, labelsize=8, length=2, width=0.6)
    bar.set_label(label, color=DARK, fontsize=9)


def _label_axes(axes: Axes, cover: Cover, view: _View) -> None:
    longitude, latitude = cover.centre
    digits = 4 if view.unit == "m" else 2
    axes.set_xlabel(f"east of {abs(longitude):.{digits}f}° {'E' if longitude >= 0 else 'W'} ({view.unit})", color=DARK, fontsize=9)
    axes.set_ylabel(f"north of {abs(latitude):.{digits}f}° {'N' if latitude >= 0 else 'S'} ({view.unit})", color=DARK, fontsize=9)
    for axis in (axes.xaxis, axes.yaxis):
        axis.set_major_locator(MaxNLocator(8, steps=[1, 2, 2.5, 5, 10]))


def _draw_histogram(axes: Axes, points: PointAccuracy) -> None:
    axes.set_title("Distribution", loc="left", fontsize=9, color=DARK)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    if not len(points):
        axes.set(xticks=[], yticks=[])
        return
    both = np.concatenate([points.ce90, points.le90])
    low, high = float(both.min()), max(float(np.percentile(v, 99.0)) for v in (points.ce90, points.le90))
    margin = max(0.03 * (high - low), 0.01 * low, 1e-6)
    edges = np.linspace(max(low - margin, 0.0), high + margin, 49)
    for values, colour, name in ((points.ce90, HORIZONTAL, "CE90"), (points.le90, VERTICAL, "LE90")):
        median = float(np.median(values))
        counts, _ = np.histogram(values, edges)
        axes.stairs(counts, edges, fill=True, color=colour, alpha=0.25)
        axes.stairs(counts, edges, color=colour, linewidth=1.1, label=f"{name}, median {_metres(median)}")
        axes.axvline(median, color=colour, linewidth=1.0, linestyle=(0, (4, 2)))
    axes.set_xlim(edges[0], edges[-1])
    axes.set_xlabel("accuracy (m)", color=DARK, fontsize=9)
    axes.set_ylabel("points", color=DARK, fontsize=9)
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.legend(
        fontsize=8,
        loc="upper right",
        labelcolor=DARK,
        handlelength=1.4,
        facecolor=PAPER,
        edgecolor="none",
        framealpha=0.85,
        borderaxespad=0.0,
    )


def _metres(value: float) -> str:
    """Three significant digits, with the unit."""
    digits = 2 - int(np.floor(np.log10(value))) if value > 0.0 else 0
    return f"{value:,.{min(max(digits, 0), 4)}f} m"


def _draw_legend(figure: Figure, layout: _Layout, cover: Cover, images: _Images, outside: int) -> None:
    entries: list[tuple[Artist, str]] = [(Line2D([], [], color=CORE, linewidth=0.9), "core of a tile")]
    if cover.overlap > 0.0:
        entries.append((Line2D([], [], color=TILE, linewidth=0.8, linestyle=DASHES), "outline of a tile"))
    if images.outlines:
        entries.append((Patch(facecolor=(COVERED, 0.5), edgecolor=IMAGE, linewidth=0.5), "footprint of an image"))
    if outside:
        entries.append((Line2D([], [], linestyle="none"), f"{_number(outside, 'point')} beyond the map"))
    _legend_row(figure, layout, entries, 0.62)
    if images.flagged_ids:
        label = f"{len(images.flagged_ids):,} of {_number(images.count, 'camera')} found to be bad: "
        letters = int(LETTERS_AN_INCH * (layout.page[0] - layout.main[0])) - len(label)
        _legend_row(
            figure,
            layout,
            [(Patch(facecolor="none", edgecolor=FLAGGED, linewidth=1.6), label + _listed(images.flagged_ids, letters))],
            0.36,
        )


def _legend_row(figure: Figure, layout: _Layout, entries: list[tuple[Artist, str]], up: float) -> None:
    """A row of the legend, so many inches from the foot of the page."""
    width, height = layout.page
    handles, labels = zip(*entries, strict=True)
    legend = figure.legend(
        handles, labels, loc="center left", bbox_to_anchor=(layout.main[0] / width, up / height), ncols=len(labels), frameon=False,
        fontsize=8.5, labelcolor=DARK, handlelength=1.8, columnspacing=1.8, borderaxespad=0.0, borderpad=0.0,
    )  # fmt: skip
    for text in legend.get_texts():
        text.set_parse_math(False)


def _listed(ids: Sequence[str], letters: int) -> str:
    """As many ids as there is room for, at least one, and how many more there are."""
    used = np.cumsum([min(len(i), LONGEST_ID) + 2 for i in ids])
    shown = max(int(np.searchsorted(used, letters - 16, side="right")), 1)
    named = ", ".join(i if len(i) <= LONGEST_ID else f"{i[: LONGEST_ID - 1]}…" for i in ids[:shown])
    return named + (f" and {len(ids) - shown:,} more" if len(ids) > shown else "")


def _number(count: int, noun: str) -> str:
    return f"{count:,} {noun}{'' if count == 1 else 's'}"


def _draw_heading(figure: Figure, layout: _Layout, network: Network, points: PointAccuracy, images: _Images, title: str | None) -> None:
    metadata, cover = network.snapshot.metadata, network.cover
    unit, metres = _unit(cover.core)
    core, overlap = (f"{length / metres:g} {unit}" for length in (cover.core, cover.overlap))
    heading = f"{metadata.name}, version {network.version}" if title is None else title
    facts = "   ·   ".join((
        _number(len(points), "point"),
        _number(images.count, "image"),
        f"{_number(cover.tile_count, 'tile')}, cores of {core}, overlap {overlap}",
        metadata.frame + (f", epoch {metadata.epoch}" if metadata.epoch else ""),
    ))  # fmt: skip
    left, top = layout.main[0] / layout.page[0], layout.page[1]
    figure.text(left, 1.0 - 0.4 / top, heading, fontsize=15, fontweight="bold", color=DARK, va="center", parse_math=False)
    figure.text(left, 1.0 - 0.68 / top, facts, fontsize=9, color=SOFT, va="center", parse_math=False)
