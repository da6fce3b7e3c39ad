"""A map of a network for people: where its points are, how good they are, and how tiles and images lie."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path

import matplotlib
import numpy as np
import shapely
from matplotlib.axes import Axes
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.collections import LineCollection, PathCollection, PolyCollection
from matplotlib.colors import ListedColormap, Normalize
from matplotlib.figure import Figure
from matplotlib.legend_handler import HandlerTuple
from matplotlib.lines import Line2D
from matplotlib.patches import Patch
from matplotlib.patheffects import withStroke
from matplotlib.ticker import MaxNLocator
from numpy.typing import NDArray

from submin import Network
from submin.errors import InputError
from submin.storage.accuracy_map import PointAccuracy, accuracy_map
from submin.tiling.cover import Cover

Array = NDArray[np.float64]
Box = tuple[float, float, float, float]

DOTS_PER_INCH = 160
METRES_BELOW = 5000.0
"""Maps of a smaller extent are in metres, others in kilometres."""
ROBUST = (2.0, 98.0)
"""Percentiles at which the colours end."""
INK = 0.10
"""Part of a map that its points would cover if they lay apart."""
MOST_NAMED = 6
"""Flagged images that are named one by one."""

PAPER, GROUND, DARK, SOFT, RULE = "#ffffff", "#f7f8fa", "#1f2933", "#616e7c", "#cbd2d9"
CORE, TILE, IMAGE, FLAGGED = "#3e4c59", "#7b8794", "#4a7fb5", "#d7263d"
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
    """Images: their number, ids of the flagged ones, and outlines (k, 2) in plane metres of all and of the flagged that have a footprint."""

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
    if not target.parent.is_dir():
        raise InputError(f"{target}: folder {target.parent} does not exist; create it first")
    figure = network_figure(network, title)
    # without the name and version of the program the same network gives the same file
    figure.savefig(target, format="png", dpi=DOTS_PER_INCH, facecolor=PAPER, metadata={"Software": None})


def network_figure(network: Network, title: str | None = None) -> Figure:
    """The figure that `draw_network` writes, on a canvas of its own: nothing of matplotlib's global state is used."""
    cover, points, images = network.cover, accuracy_map(network), _images(network)
    plane = np.column_stack(cover.plane(points.geodetic[:, 0], points.geodetic[:, 1])) if len(points) else np.empty((0, 2))
    view = _view(cover, plane)
    place = plane / view.metres
    layout = _layout(view.aspect)
    figure = Figure(figsize=layout.page, facecolor=PAPER)
    FigureCanvasAgg(figure)

    main, small = _axes(figure, layout, layout.main), _axes(figure, layout, layout.small)
    for axes, values, bar, label, box in (
        (main, points.ce90, layout.main_bar, "CE90 of a point (m)", layout.main),
        (small, points.le90, layout.small_bar, "LE90 (m)", layout.small),
    ):
        _draw_ground(axes, cover, view, images, detail=axes is main)
        if len(points):
            scatter = _draw_points(axes, place, values, box)
            _draw_bar(figure, _axes(figure, layout, bar), scatter, values, label)
    _label_axes(main, cover, view)
    if not len(points):
        main.text(0.5, 0.5, "no determined points yet", transform=main.transAxes, ha="center", va="center", color=SOFT, fontsize=13)
    _strip(small, "Vertical accuracy")
    _draw_histogram(_axes(figure, layout, layout.histogram), points)
    _draw_legend(main, images, int((~view.holds(place)).sum()))
    _draw_heading(figure, layout, network, points, images, title)
    return figure


def _images(network: Network) -> _Images:
    columns = network.snapshot.image_columns(["image_id", "footprint", "released"])
    flagged = columns["released"] == 1
    given = columns["footprint"] != ""
    outlines = [_outline(network.cover, polygon) for polygon in shapely.from_wkb(columns["footprint"][given])]
    chosen = [outline for outline, bad in zip(outlines, flagged[given], strict=True) if bad]
    return _Images(len(flagged), columns["image_id"][flagged].tolist(), outlines, chosen)


def _outline(cover: Cover, polygon: shapely.Polygon) -> Array:
    """Corners (k, 2) of a footprint in plane metres; its sides are straight there, so it may cross the antimeridian."""
    corners = shapely.get_coordinates(polygon)
    plane = np.column_stack(cover.plane(corners[:, 0], corners[:, 1]))
    return plane[np.isfinite(plane).all(axis=1)]


def _view(cover: Cover, plane: Array) -> _View:
    """All tiles and points; but of points outside the area only those that are no further than a core, lest one of them shrink the map."""
    half = 0.5 * cover.overlap
    low = np.asarray(cover.origin) - half
    high = np.asarray(cover.origin) + cover.core * np.array([cover.columns, cover.rows]) + half
    if len(plane):
        low = np.maximum(np.minimum(low, plane.min(axis=0)), low - cover.core)
        high = np.minimum(np.maximum(high, plane.max(axis=0)), high + cover.core)
    middle, size = 0.5 * (low + high), 1.04 * (high - low)
    # a page is no ribbon
    size = np.maximum(size, size[::-1] * (0.4, 0.4))
    unit, metres = ("m", 1.0) if size.max() < METRES_BELOW else ("km", 1000.0)
    west, south = (middle - 0.5 * size) / metres
    east, north = (middle + 0.5 * size) / metres
    return _View((float(west), float(south), float(east), float(north)), unit, metres)


def _layout(aspect: float) -> _Layout:
    width = min(8.0, 7.2 * aspect)
    height = width / aspect
    tall = max(height, 5.6)
    left, below, above, bar, column = 0.95, 1.35, 0.95, 0.16, 2.9
    small_width = min(column, 3.1 * aspect)
    small_height = small_width / aspect
    right = left + width + 1.55
    top = below + tall
    return _Layout(
        page=(right + column + 0.85, top + above),
        main=(left, top - height, width, height),
        main_bar=(left + width + 0.18, top - height, bar, height),
        small=(right, top - small_height, small_width, small_height),
        small_bar=(right + small_width + 0.14, top - small_height, 0.7 * bar, small_height),
        histogram=(right, below, column, tall - small_height - 0.75),
    )


def _axes(figure: Figure, layout: _Layout, box: Box) -> Axes:
    width, height = layout.page
    axes = figure.add_axes((box[0] / width, box[1] / height, box[2] / width, box[3] / height))
    axes.tick_params(colors=SOFT, labelsize=8, length=3, width=0.6)
    for spine in axes.spines.values():
        spine.set(color=RULE, linewidth=0.8)
    return axes


def _draw_ground(axes: Axes, cover: Cover, view: _View, images: _Images, *, detail: bool) -> None:
    """Footprints, cores, tiles: what lies beneath the points."""
    west, south, east, north = view.box
    axes.set(xlim=(west, east), ylim=(south, north), facecolor=GROUND, aspect="equal")
    x = (cover.origin[0] + cover.core * np.arange(cover.columns + 1)) / view.metres
    y = (cover.origin[1] + cover.core * np.arange(cover.rows + 1)) / view.metres
    many = max(cover.rows, cover.columns)
    if detail:
        _draw_footprints(axes, view, images)
        half = 0.5 * cover.overlap / view.metres
        if half > 0.0:
            sides = np.unique(np.concatenate([x - half, x + half])), np.unique(np.concatenate([y - half, y + half]))
            lines = LineCollection(
                _grid(*sides), colors=TILE, linewidths=0.6 if many <= 20 else 0.3, linestyles=[(0, (5, 4))], alpha=0.65, zorder=2
            )
            axes.add_collection(lines, autolim=False)
        _name_tiles(axes, cover, view)
    axes.add_collection(
        LineCollection(_grid(x, y), colors=CORE, linewidths=0.9 if detail and many <= 20 else 0.4, zorder=2.1), autolim=False
    )


def _grid(x: Array, y: Array) -> list[Array]:
    """Lines along every x over the whole of y, and along every y over the whole of x."""
    return [np.array([[v, y[0]], [v, y[-1]]]) for v in x] + [np.array([[x[0], v], [x[-1], v]]) for v in y]


def _draw_footprints(axes: Axes, view: _View, images: _Images) -> None:
    outlines = [outline / view.metres for outline in images.outlines]
    if outlines:
        west, south, east, north = view.box
        covered = sum(float(shapely.area(shapely.polygons(o))) for o in outlines if len(o) > 3)
        depth = max(covered / ((east - west) * (north - south)), 1.0)
        # places of average coverage become a quarter blue, however many images cover them
        face = 1.0 - 0.75 ** (1.0 / depth)
        edge = float(np.clip(12.0 / np.sqrt(len(outlines)), 0.08, 0.45))
        faces = PolyCollection(outlines, facecolors=[(*matplotlib.colors.to_rgb(IMAGE), face)], edgecolors="none", zorder=1)
        edges = PolyCollection(outlines, facecolors="none", edgecolors=[(*matplotlib.colors.to_rgb(IMAGE), edge)], linewidths=0.5, zorder=1.1)
        for collection in (faces, edges):
            collection.set_rasterized(True)
            axes.add_collection(collection, autolim=False)
    if images.flagged_outlines:
        flagged = [outline / view.metres for outline in images.flagged_outlines]
        axes.add_collection(
            PolyCollection(flagged, facecolors="none", edgecolors=FLAGGED, linewidths=1.6, zorder=4), autolim=False
        )


def _name_tiles(axes: Axes, cover: Cover, view: _View) -> None:
    """Names in the corners of the cores, where there is room for them."""
    west, _, east, _ = view.box
    figure = axes.get_figure()
    assert figure is not None
    inches = axes.get_position().width * figure.get_figwidth() * cover.core / view.metres / (east - west)
    if inches < 0.7:
        return
    for tile in cover.tiles():
        left, _, _, top = cover.core_outline(tile)[[0, 1, 2, 3], [0, 1, 0, 1]] / view.metres
        axes.annotate(
            cover.tile_name(tile), (left, top), xytext=(3, -3), textcoords="offset points", ha="left", va="top", fontsize=6.5,
            color=SOFT, zorder=5, path_effects=[withStroke(linewidth=1.8, foreground=GROUND)], annotation_clip=True,
        )  # fmt: skip


def _draw_points(axes: Axes, place: Array, values: Array, box: Box) -> PathCollection:
    order = np.argsort(values, kind="stable")  # the worst on top: they are what one looks for
    size = float(np.clip(INK * box[2] * box[3] * 72.0**2 / len(values), 0.12, 26.0))
    return axes.scatter(
        place[order, 0], place[order, 1], c=values[order], s=size, cmap=COLOURS, norm=Normalize(*_limits(values)), linewidths=0.0,
        rasterized=True, zorder=3,
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
    bar.outline.set(linewidth=0.0)  # type: ignore[operator]
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


def _strip(axes: Axes, heading: str) -> None:
    axes.set(xticks=[], yticks=[])
    axes.set_title(heading, loc="left", fontsize=9, color=DARK)


def _draw_histogram(axes: Axes, points: PointAccuracy) -> None:
    axes.set_title("Distribution", loc="left", fontsize=9, color=DARK)
    for side in ("top", "right"):
        axes.spines[side].set_visible(False)
    if not len(points):
        axes.set(xticks=[], yticks=[])
        return
    both = np.concatenate([points.ce90, points.le90])
    low, high = float(both.min()), max(float(np.percentile(v, 99.0)) for v in (points.ce90, points.le90))
    edges = np.linspace(low, max(high, low * 1.02 + 1e-6), 49)
    for values, colour, name in ((points.ce90, HORIZONTAL, "CE90"), (points.le90, VERTICAL, "LE90")):
        median = float(np.median(values))
        counts, _ = np.histogram(values, edges)
        axes.stairs(counts, edges, fill=True, color=colour, alpha=0.25)
        axes.stairs(counts, edges, color=colour, linewidth=1.1, label=f"{name}, median {_metres(median)}")
        axes.axvline(median, color=colour, linewidth=1.0, linestyle=(0, (4, 2)))
    axes.set_xlim(edges[0], edges[-1])
    axes.set_xlabel("m", color=DARK, fontsize=9)
    axes.set_ylabel("points", color=DARK, fontsize=9)
    axes.yaxis.set_major_locator(MaxNLocator(4, integer=True))
    axes.legend(frameon=False, fontsize=8, loc="upper right", labelcolor=DARK, handlelength=1.4)


def _metres(value: float) -> str:
    """Three significant digits, with the unit."""
    digits = 2 - int(np.floor(np.log10(value))) if value > 0.0 else 0
    return f"{value:,.{min(max(digits, 0), 4)}f} m"


def _draw_legend(axes: Axes, images: _Images, outside: int) -> None:
    handles = [
        Line2D([], [], color=CORE, linewidth=0.9),
        Line2D([], [], color=TILE, linewidth=0.8, linestyle=(0, (5, 4))),
        Patch(facecolor=(*matplotlib.colors.to_rgb(IMAGE), 0.25), edgecolor=IMAGE, linewidth=0.5),
    ]  # fmt: skip
    labels = ["core of a tile", "outline of a tile", "footprint of an image"]
    if images.flagged_ids:
        named = ", ".join(_shortened(image_id) for image_id in images.flagged_ids[:MOST_NAMED])
        more = len(images.flagged_ids) - MOST_NAMED
        handles.append(Patch(facecolor="none", edgecolor=FLAGGED, linewidth=1.6))
        labels.append(f"bad camera: {named}" + (f" and {more} more" if more > 0 else ""))
    if outside:
        handles.append(Line2D([], [], linestyle="none"))
        labels.append(f"{outside} points lie beyond the map")
    legend = axes.legend(
        handles, labels, loc="upper left", bbox_to_anchor=(-0.01, -0.09), ncols=3, frameon=False, fontsize=8.5, labelcolor=DARK,
        handlelength=1.8, columnspacing=1.6, borderaxespad=0.0, handler_map={tuple: HandlerTuple()},
    )  # fmt: skip
    for text in legend.get_texts():
        text.set_parse_math(False)


def _shortened(text: str, most: int = 32) -> str:
    return text if len(text) <= most else f"{text[: most - 1]}…"


def _draw_heading(figure: Figure, layout: _Layout, network: Network, points: PointAccuracy, images: _Images, title: str | None) -> None:
    metadata, cover = network.snapshot.metadata, network.cover
    unit, metres = ("m", 1.0) if cover.core < METRES_BELOW else ("km", 1000.0)
    heading = f"{metadata.name}, version {network.version}" if title is None else title
    facts = (
        f"{len(points):,} points   ·   {images.count:,} images   ·   {cover.rows * cover.columns:,} tiles, cores of {cover.core / metres:g} {unit}, "
        f"overlap {cover.overlap / metres:g} {unit}   ·   {metadata.frame}" + (f", epoch {metadata.epoch}" if metadata.epoch else "")
    )
    left, top = layout.main[0] / layout.page[0], layout.page[1]
    figure.text(left, 1.0 - 0.36 / top, heading, fontsize=15, fontweight="bold", color=DARK, va="center", parse_math=False)
    figure.text(left, 1.0 - 0.64 / top, facts, fontsize=9, color=SOFT, va="center", parse_math=False)
