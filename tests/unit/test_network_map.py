"""The map of a network, and the accuracy of every point that it shows."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
import shapely
from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from matplotlib.image import imread
from networks import area_of, fuse

import submin
from orchestration import network_map
from orchestration.create import create
from orchestration.network_map import draw_network, network_figure
from orchestration.run import RunResult
from submin.errors import InputError, QueryError
from submin.simulation.region import RegionDesign, simulate_region
from submin.storage.accuracy_map import PointAccuracy
from submin.storage.catalogue_schema import CatalogueMetadata
from submin.storage.simulated import write_region
from submin.tiling.area import cover_area

RED = np.array([0xD7, 0x26, 0x3D]) / 255.0


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> tuple[submin.Network, RunResult]:
    """A network of four tiles and twelve images with one bad camera."""
    folder = tmp_path_factory.mktemp("map")
    region = simulate_region(RegionDesign(width_km=60.0, height_km=60.0, point_spacing_km=6.0, bad_camera_sigmas=20.0))
    write_region(region, folder / "catalogue")
    result = fuse(folder / "catalogue", folder / "network", area_of(region), tile_km=40.0, overlap_km=15.0)
    return submin.open(folder / "network"), result


@pytest.fixture(scope="module")
def network(made: tuple[submin.Network, RunResult]) -> submin.Network:
    return made[0]


@pytest.fixture(scope="module")
def every(network: submin.Network) -> PointAccuracy:
    return network.accuracy()


@pytest.fixture(scope="module")
def drawn(network: submin.Network, tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("drawn") / "map.png"
    draw_network(network, path)
    return path


@pytest.fixture
def empty(tmp_path: Path) -> submin.Network:
    create(str(tmp_path / "empty"), shapely.box(10.0, 50.0, 10.002, 50.001), CatalogueMetadata("empty"), 0.1, 0.05)
    return submin.open(tmp_path / "empty")


def texts(network: submin.Network) -> str:
    figure = network_figure(network)
    figure.canvas.draw()
    return "\n".join(text.get_text() for text in figure.findobj(lambda artist: hasattr(artist, "get_text")))


def drawn_pixels(figure: Figure) -> np.ndarray:
    """Red, green and blue from 0 to 1 of a drawn figure, its first row at the top."""
    assert isinstance(figure.canvas, FigureCanvasAgg)
    figure.canvas.draw()
    return np.asarray(figure.canvas.buffer_rgba())[..., :3] / 255.0


class TestAccuracyMap:
    def test_is_that_of_the_owner_tile_alone(self, network: submin.Network, every: PointAccuracy) -> None:
        tiles = np.unique(every.tile)
        assert len(tiles) == 4
        for name in tiles:
            own = every.tile == name
            asked = network.query(points=every.ids[own], tile=str(name), policy="tile")
            row = np.searchsorted(asked.ids, every.ids[own])
            assert (asked.tile_of_point[row] == name).all()
            np.testing.assert_allclose(every.ce90[own], asked.ce90[row], rtol=0.0, atol=1e-9)
            np.testing.assert_allclose(every.le90[own], asked.le90[row], rtol=0.0, atol=1e-9)
            np.testing.assert_allclose(every.geodetic[own], asked.geodetic[row], rtol=0.0, atol=1e-9)
            np.testing.assert_array_equal(every.rays[own], asked.rays[row])

    def test_has_every_determined_point_once(self, network: submin.Network, every: PointAccuracy) -> None:
        assert len(every) == len(np.unique(every.ids)) > 80
        west, south = every.geodetic[:, :2].min(axis=0) - 0.1
        east, north = every.geodetic[:, :2].max(axis=0) + 0.1
        asked = network.query(bbox=(west, south, east, north), policy="rigorous")
        np.testing.assert_array_equal(np.sort(every.ids), asked.ids)

    def test_is_asked_for_like_a_query(self, network: submin.Network, every: PointAccuracy) -> None:
        (west, south), (east, north) = every.geodetic[:, :2].min(axis=0) + 0.1, every.geodetic[:, :2].max(axis=0) - 0.1
        area = shapely.Polygon([(west, south), (east, south), (east, north)])
        some = every.ids[::7]
        for question in ({"bbox": (west, south, east, north)}, {"area": area}, {"points": some}, {"area": area, "tile": "r000c001"}):
            found, asked = network.accuracy(**question), network.query(**question)
            np.testing.assert_array_equal(np.sort(found.ids), asked.ids)
            assert 10 < len(found) < len(every)
            if "tile" not in question:
                row = np.flatnonzero(np.isin(every.ids, found.ids))
                assert set(found.ids) == set(every.ids[row])
                by_id, same = np.argsort(found.ids), row[np.argsort(every.ids[row])]
                np.testing.assert_allclose(found.local_covariance[by_id], every.local_covariance[same], rtol=1e-10)

    def test_of_a_tile_is_that_of_this_tile_alone(self, network: submin.Network) -> None:
        found, asked = network.accuracy(tile="r000c001"), network.query(tile="r000c001")
        by_id = np.argsort(found.ids)
        np.testing.assert_array_equal(found.ids[by_id], asked.ids)
        assert set(found.tile) == {"r000c001"} < set(asked.tile_of_point)
        np.testing.assert_allclose(found.local_covariance[by_id], asked.local_covariance, rtol=1e-9)
        np.testing.assert_allclose(found.geodetic[by_id], asked.geodetic, rtol=0.0, atol=1e-9)
        np.testing.assert_allclose(found.ce90[by_id], asked.ce90, rtol=1e-9)
        np.testing.assert_allclose(found.le90[by_id], asked.le90, rtol=1e-9)

    def test_refuses_what_a_query_refuses(self, network: submin.Network) -> None:
        with pytest.raises(QueryError, match="not in the network"):
            network.accuracy(points=["nowhere"])
        with pytest.raises(QueryError, match="asked by bbox and points"):
            network.accuracy(bbox=(99.0, 34.0, 101.0, 36.0), points=["nowhere"])
        with pytest.raises(QueryError, match="longitude and latitude look swapped"):
            network.accuracy(bbox=(35.0, 99.0, 36.0, 101.0))

    def test_of_an_empty_network(self, empty: submin.Network) -> None:
        every = empty.accuracy()
        assert len(every) == 0
        assert every.geodetic.shape == (0, 3)


class TestDrawing:
    def test_is_a_png_with_the_bad_camera_in_red(self, drawn: Path) -> None:
        assert drawn.read_bytes()[:8] == b"\x89PNG\r\n\x1a\n"
        picture = imread(drawn)[..., :3]
        assert 1000 < picture.shape[0] < 3000 and 1000 < picture.shape[1] < 3000
        assert (np.abs(picture - RED).max(axis=-1) < 0.02).sum() > 500

    @pytest.mark.parametrize("panel", [0, 1])
    def test_points_are_where_they_are_in_the_colour_of_their_accuracy(
        self, network: submin.Network, every: PointAccuracy, panel: int
    ) -> None:
        figure = network_figure(network)
        axes, values = figure.axes[panel], (every.ce90, every.le90)[panel]
        picture = drawn_pixels(figure)
        place = np.column_stack(network.cover.plane(every.geodetic[:, 0], every.geodetic[:, 1])) / 1000.0
        column, up = np.rint(axes.transData.transform(place) - 0.5).astype(int).T
        low, high = network_map._limits(values)
        expected = network_map.COLOURS(np.clip((values - low) / (high - low), 0.0, 1.0))[:, :3]
        found = picture[len(picture) - 1 - up, column]
        # outlines, names and neighbours hide a few
        assert (np.abs(found - expected).max(axis=-1) < 0.05).mean() > 0.9
        assert len(np.unique(expected.round(1), axis=0)) > 3

    def test_the_same_network_gives_the_same_file(self, network: submin.Network, drawn: Path, tmp_path: Path) -> None:
        draw_network(submin.open(network.snapshot.place), tmp_path / "again.png")
        assert (tmp_path / "again.png").read_bytes() == drawn.read_bytes()

    def test_says_what_it_shows(self, made: tuple[submin.Network, RunResult], every: PointAccuracy) -> None:
        network, result = made
        shown = texts(network)
        assert result.flagged
        assert f"{len(every):,} points" in shown
        assert f"{network.snapshot.image_count()} images" in shown
        assert "cores of 40 km, overlap 15 km" in shown
        assert "(km)" in shown
        assert f"CE90, median {np.median(every.ce90):.1f} m" in shown
        assert f"LE90, median {np.median(every.le90):.1f} m" in shown
        assert all(f.image_id in shown for f in result.flagged)
        assert "r001c001" in shown
        assert "beyond the map" not in shown

    def test_an_empty_network_is_drawn_in_metres(self, empty: submin.Network, tmp_path: Path) -> None:
        draw_network(empty, tmp_path / "map.png", title="$nothing$ yet")
        assert imread(tmp_path / "map.png").shape[0] > 1000
        shown = texts(empty)
        assert "no determined points yet" in shown
        assert "0 points" in shown and "(m)" in shown and "cores of 100 m, overlap 50 m" in shown
        assert "bad" not in shown and "footprint" not in shown

    @pytest.mark.parametrize("name", ["map.jpg", "map", "nowhere/map.png"])
    def test_a_name_that_cannot_be_written_is_refused(self, empty: submin.Network, tmp_path: Path, name: str) -> None:
        with pytest.raises(InputError, match=r"expected a name that ends in \.png|does not exist; create it first"):
            draw_network(empty, tmp_path / name)
        assert not (tmp_path / name).exists()


class TestView:
    cover = cover_area(shapely.box(10.0, 50.0, 12.0, 51.0), 50e3, 20e3)

    def test_holds_all_tiles_and_near_points(self) -> None:
        outlines = np.concatenate([self.cover.tile_outline(tile) for tile in self.cover.tiles()])
        point = outlines.max(axis=0) + 30e3
        view = network_map._view(self.cover, point[None])
        assert view.unit == "km"
        assert view.holds(outlines / 1000.0).all() and view.holds(point[None] / 1000.0).all()

    def test_a_far_point_does_not_shrink_the_map(self) -> None:
        far = np.array([[2e6, 0.0]])
        near, view = network_map._view(self.cover, np.empty((0, 2))), network_map._view(self.cover, far)
        assert not view.holds(far / 1000.0).any()
        assert view.box[2] - view.box[0] < (near.box[2] - near.box[0]) + 60.0

    @pytest.mark.parametrize("box", [(0.0, 0.0, 10.0, 0.1), (0.0, 0.0, 0.1, 10.0), (0.0, 0.0, 1.0, 1.0), (0.0, 0.0, 2.0, 1.0)])
    def test_nothing_overlaps_on_the_page(self, box: tuple[float, float, float, float]) -> None:
        view = network_map._view(cover_area(shapely.box(*box), 20e3, 5e3), np.empty((0, 2)))
        layout = network_map._layout(view.aspect)
        parts = [
            shapely.box(x, y, x + w, y + h)
            for x, y, w, h in (layout.main, layout.main_bar, layout.small, layout.small_bar, layout.histogram)
        ]
        page = shapely.box(0.0, 0.0, *layout.page)
        assert all(page.buffer(-0.4).contains(part) for part in parts)
        assert all(a.distance(b) > 0.1 for k, a in enumerate(parts) for b in parts[:k])
        assert min(layout.histogram[2:]) > 1.5


class TestLegend:
    def test_names_as_many_as_there_is_room_for(self) -> None:
        ids = [f"image-{k:03d}" for k in range(100)]
        assert network_map._listed(ids[:2], 100) == "image-000, image-001"
        line = network_map._listed(ids, 100)
        assert len(line) <= 100
        assert line.endswith(f" and {100 - line.count('image')} more")
        assert network_map._listed(["x" * 200], 10) == "x" * 39 + "…"

    @pytest.mark.parametrize(("value", "text"), [(1234.5, "1,234 m"), (12.345, "12.3 m"), (0.012345, "0.0123 m"), (0.0, "0 m")])
    def test_lengths_have_three_digits(self, value: float, text: str) -> None:
        assert network_map._metres(value) == text

    @pytest.mark.parametrize("values", [np.full(7, 3.0), np.zeros(3), np.array([5.0])])
    def test_colours_of_equal_values_have_ends_apart(self, values: np.ndarray) -> None:
        low, high = network_map._limits(values)
        assert 0.0 <= low <= values[0] <= high and high > low

    def test_colours_end_at_robust_percentiles(self) -> None:
        values = np.append(np.linspace(1.0, 2.0, 1000), 1e6)
        low, high = network_map._limits(values)
        assert 1.0 < low < 1.05 and 1.95 < high < 2.0
