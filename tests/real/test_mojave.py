"""Two real WorldView-2 images of the Mojave desert: the pushbroom model of their orbits and attitudes against the vendor's own RPCs.

The RPCs are smooth, the attitudes are not: what is left is a function of the line, the same at every height, of up to 0.4 pixel. All else
agrees to a few hundredths of a pixel, with nothing fitted: pixel frame, line times, aberration, refraction, the turn of the Earth. Ground
points and rays are simulated; the cameras are real.
"""

from __future__ import annotations

import gzip
import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import shapely
from networks import fuse
from numpy.typing import NDArray
from scipy.stats import chi2

import submin
from submin.accuracy import nees_per_dof
from submin.adjustment.adjustment import adjust
from submin.adjustment.elimination import eliminate, linearise, point_factors
from submin.adjustment.estimation import estimate_images
from submin.adjustment.images import ImageSet
from submin.adjustment.intersection import intersect
from submin.adjustment.priors import APriori, ImagePrior
from submin.adjustment.rays import sorted_rays
from submin.errors import InputError
from submin.formats.worldview import WorldViewImage, read_worldview
from submin.geodesy import WGS84, geocentric_to_geodetic, geodetic_to_geocentric, local_axes
from submin.network.sub_min import GroundPart, joint_covariance, loadings
from submin.sensors import Ground, sensor_named
from submin.storage.catalogue_schema import Block, CatalogueMetadata, ImageRecord
from submin.storage.catalogue_writer import CatalogueWriter

Array = NDArray[np.float64]

PUSHBROOM, RPC = sensor_named("pushbroom"), sensor_named("rpc")
HEIGHTS = (94.0, 594.0, 1094.0)
"""The vendor's RPCs are said to hold from 93 to 1 094 m."""
GRID = (61, 15)
"""Lines and samples of the grid: 61 lines are one every 0.02 s or so, the spacing of attitude samples."""


@dataclass(frozen=True)
class Compared:
    """One real image, and a grid of ground points that the vendor's RPC places in it."""

    image: WorldViewImage

    @cached_property
    def pixels(self) -> Array:
        """Samples and lines (n, 2), by line, sample and height."""
        lines, samples = np.linspace(0.0, self.image.height - 1.0, GRID[0]), np.linspace(0.0, self.image.width - 1.0, GRID[1])
        mesh = np.meshgrid(lines, samples, HEIGHTS, indexing="ij")
        return np.stack([mesh[1].ravel(), mesh[0].ravel()], axis=1)

    @cached_property
    def ground(self) -> Ground:
        heights = np.tile(HEIGHTS, GRID[0] * GRID[1])
        camera = RPC.pack(self.image.rpc, self.image.width, self.image.height)[None]
        geodetic = RPC.localise(camera, rows(len(heights)), self.pixels[:, 0], self.pixels[:, 1], heights, WGS84)
        return Ground.at(geodetic_to_geocentric(geodetic))

    def difference(self, **changes: Any) -> Array:
        """Pushbroom less RPC (n, 2), pixels; ``changes`` to the description of the camera."""
        camera = self.image.camera | changes
        cameras = PUSHBROOM.pack({k: v for k, v in camera.items() if v is not None}, self.image.width, self.image.height)[None]
        return np.asarray(project(cameras, self.ground).image - self.pixels)


def rows(count: int) -> NDArray[np.int32]:
    return np.zeros(count, dtype=np.int32)


def project(cameras: Array, ground: Ground) -> Any:
    count = len(ground.geocentric)
    return PUSHBROOM.project(cameras, np.zeros((1, 6)), ground, rows(count), np.arange(count, dtype=np.int32))


@pytest.fixture(scope="module")
def files(data: Path) -> list[Path]:
    return [data / "wv02_rigorous_mojave" / f"wv_mvp_{k}.xml.gz" for k in (1, 2)]


@pytest.fixture(scope="module")
def pair(files: list[Path]) -> list[Compared]:
    return [Compared(read_worldview(file)) for file in files]


@pytest.mark.parametrize("k", [0, 1])
def test_the_model_is_the_vendors(pair: list[Compared], k: int) -> None:
    difference = pair[k].difference()
    rms, largest = np.sqrt(np.mean(difference**2, axis=0)), np.abs(difference).max(axis=0)
    print(f"\nimage {k + 1}: sample rms {rms[0]:.3f}, max {largest[0]:.3f} px; line rms {rms[1]:.3f}, max {largest[1]:.3f} px")
    assert largest.max() < 0.4
    assert rms.max() < 0.23
    # no constant: a pixel frame that begins at 0.5, or lines timed at their beginning, would show 0.5
    assert np.abs(difference.mean(axis=0)).max() < 0.07


@pytest.mark.parametrize("k", [0, 1])
def test_what_an_rpc_cannot_follow_is_the_attitude_from_line_to_line(pair: list[Compared], k: int) -> None:
    by_line = pair[k].difference().reshape(*GRID, len(HEIGHTS), 2)
    left = by_line - by_line.mean(axis=(1, 2), keepdims=True)
    assert np.abs(left).max() < 0.015
    assert by_line.mean(axis=(1, 2)).std(axis=0).max() > 10.0 * left.std()


def test_aberration_refraction_and_the_turn_of_the_earth_are_in_the_vendors_model(pair: list[Compared]) -> None:
    for compared, sample, line in ((pair[0], 9.0, 38.2), (pair[1], 9.8, 36.0)):
        still = np.abs(compared.difference(aberration=None).mean(axis=0))
        np.testing.assert_allclose(still, [sample, line], rtol=0.0, atol=0.3)
    # the first looks 5 degrees off the vertical, the second 30; away from the nadir in each
    for compared, sample, line in ((pair[0], 0.09, -0.38), (pair[1], -0.71, 2.62)):
        np.testing.assert_allclose(compared.difference(refraction=None).mean(axis=0), [sample, line], rtol=0.0, atol=0.03)
    # 0.2 to 0.4 pixel across the track: how far the ground turns while the light travels
    for compared, sample in ((pair[0], -0.23), (pair[1], -0.32)):
        still_body = compared.difference(aberration={"rotation_rate": 0.0}).mean(axis=0)
        np.testing.assert_allclose(still_body[0], sample, rtol=0.0, atol=0.03)


def test_stated_accuracy_of_the_rpc_is_the_covariance_of_attitude_and_orbit(pair: list[Compared]) -> None:
    """ERR_BIAS is the radial RMS on the ground of what ATT and EPH state: so their lists are upper triangles, in these axes."""
    for compared in pair:
        image = compared.image
        cameras = PUSHBROOM.pack(image.camera, image.width, image.height)[None]
        middle = np.array([0.5 * image.width]), np.array([0.5 * image.height])
        geodetic = PUSHBROOM.localise(cameras, rows(1), *middle, np.array([594.0]), WGS84)
        seen = project(cameras, Ground.at(geodetic_to_geocentric(geodetic)))
        axes = local_axes(geodetic)[0]
        by_plane = (seen.by_ground[0] @ axes.T)[:, :2]
        by_attitude = np.linalg.solve(by_plane, seen.by_parameters[0, :, :3])
        by_position = np.linalg.solve(by_plane, seen.by_ground[0])
        plane = by_attitude @ image.attitude_covariance @ by_attitude.T + by_position @ image.position_covariance @ by_position.T
        radial = np.sqrt(np.trace(plane))
        np.testing.assert_allclose(radial, image.rpc["ERR_BIAS"], rtol=0.01)
        assert image.uncertainties["attitude roll"]["sigma"] == pytest.approx(np.sqrt(image.attitude_covariance[0, 0]))


def places(rng: np.random.Generator, points: int) -> Array:
    """Geocentric coordinates (n, 3) of points that both images see."""
    low, high = (-116.23, 35.15, HEIGHTS[0]), (-116.09, 35.24, HEIGHTS[-1])
    return geodetic_to_geocentric(rng.uniform(low, high, (points, 3)))


def stereo(pair: list[Compared], points: int, sigma: float) -> tuple[Array, Array, Array]:
    """Errors (n, 3) of points intersected from rays with that noise, their covariances (n, 3, 3), and the truth (n, 3), metres."""
    rng = np.random.default_rng(17)
    truth = places(rng, points)
    cameras = [PUSHBROOM.pack(c.image.camera, c.image.width, c.image.height)[None] for c in pair]
    observed = [project(camera, Ground.at(truth)).image for camera in cameras]
    for compared, image in zip(pair, observed, strict=True):
        assert ((image >= 0.0) & (image < [compared.image.width, compared.image.height])).all()
    observed = [image + rng.normal(0.0, sigma, image.shape) for image in observed]
    middle = PUSHBROOM.localise(cameras[0], rows(points), observed[0][:, 0], observed[0][:, 1], np.full(points, 594.0), WGS84)
    ground = geodetic_to_geocentric(middle)
    for _ in range(5):
        seen = [project(camera, Ground.at(ground)) for camera in cameras]
        design = np.concatenate([s.by_ground for s in seen], axis=1)
        misclosure = np.concatenate([image - s.image for image, s in zip(observed, seen, strict=True)], axis=1)
        normal = np.einsum("nri,nrj->nij", design, design)
        ground = ground + np.linalg.solve(normal, np.einsum("nri,nr->ni", design, misclosure)[..., None])[..., 0]
    return ground - truth, sigma**2 * np.linalg.inv(normal), truth


def test_rays_without_noise_meet_in_the_truth(pair: list[Compared]) -> None:
    error, _, _ = stereo(pair, 200, 0.0)
    assert np.abs(error).max() < 1e-6


def test_errors_of_points_are_what_their_covariance_says(pair: list[Compared]) -> None:
    error, covariance, truth = stereo(pair, 2000, 1.0)
    normalised = np.einsum("ni,ni->n", error, np.linalg.solve(covariance, error[..., None])[..., 0])
    assert abs(normalised.mean() - 3.0) < 4.0 * np.sqrt(6.0 / 2000)
    assert abs(np.mean(normalised < chi2.ppf(0.9, 3)) - 0.9) < 4.0 * np.sqrt(0.09 / 2000)
    up = local_axes(geocentric_to_geodetic(truth))[:, 2]
    sigma_up = np.sqrt(np.einsum("ni,nij,nj->n", up, covariance, up))
    # half a metre of pixel, rays that meet at 35 degrees
    np.testing.assert_allclose(sigma_up, 1.17, rtol=0.0, atol=0.01)


def test_an_adjusted_pair_is_as_accurate_as_it_says(pair: list[Compared]) -> None:
    """Simulated errors of attitude and rate, correlated by 75 % as images of a pass are; over all points of 30 realisations together."""
    packed = [PUSHBROOM.pack(c.image.camera, c.image.width, c.image.height) for c in pair]
    cameras = np.full((2, max(map(len, packed))), np.nan)
    for row, values in zip(cameras, packed, strict=True):
        row[: len(values)] = values
    a_priori = APriori(correlation="fixed", correlation_parameter=0.75)
    priors = tuple(ImagePrior("block", "pass", 67.5 * k, a_priori, PUSHBROOM.parameters) for k in range(2))
    images = ImageSet(("one", "two"), ("pushbroom", "pushbroom"), cameras, priors, 6)
    points, realisations, total = 20, 30, 0.0
    point, image = np.repeat(np.arange(points, dtype=np.int32), 2), np.tile(np.arange(2, dtype=np.int32), points)
    for seed in range(30, 30 + realisations):  # in none of which one of the good cameras is flagged, as in 3 % of pairs judged alone
        rng = np.random.default_rng(seed)
        truth = places(rng, points)
        theta = np.asarray(images.prior @ rng.normal(size=images.prior.shape[1])).reshape(2, 6)
        observed = images.project(theta, images.ground(truth), image, point).image + rng.normal(0.0, 1.0, (2 * points, 2))
        rays = sorted_rays(point, image, observed, np.ones_like(observed), np.ones(2 * points, dtype=np.bool_))
        result = adjust(images, rays, intersect(images, rays, points))
        assert result.converged and result.accepted.all() and not result.released.any()
        linear = linearise(images, rays, result.theta, result.ground, result.ground)
        weight = np.ones(len(rays))
        estimate = estimate_images(eliminate(linear, weight, 2), images.prior, 6)
        factors = point_factors(linear, weight)
        loading = loadings([GroundPart(result.ground, linear, factors)], np.arange(2, dtype=np.int32), 6)
        error = (result.ground - truth).ravel()
        total += error @ np.linalg.solve(joint_covariance(loading, factors.own, estimate.covariance), error)
    freedom = 3 * points * realisations
    assert abs(total / freedom - 1.0) < 4.0 * np.sqrt(2.0 / freedom)


def test_description_goes_through_a_catalogue(pair: list[Compared]) -> None:
    image = pair[0].image
    record = ImageRecord(
        image.image_id, "block", "pass", image.satellite, "pushbroom", json.dumps(image.camera), image.width, image.height, image.acquired
    )
    np.testing.assert_array_equal(record.pack(), PUSHBROOM.pack(image.camera, image.width, image.height))
    assert (image.image_id, image.satellite, image.band, image.width, image.height) == ("1030010033C4AA00", "WV02", "P", 32837, 27968)
    assert image.acquired == "2014-06-19T18:52:50.787577Z"
    assert len(record.camera) < 40_000


def test_a_catalogue_of_the_pair_becomes_a_network(pair: list[Compared], tmp_path: Path) -> None:
    """Simulated rays through the product's own path: catalogue, stage 1, tiles, query; attitudes as the vendor states them, rates not."""
    points, rng = 300, np.random.default_rng(4)
    truth = places(rng, points)
    a_priori = APriori(parameters=pair[0].image.uncertainties | {"rate": {"sigma": 0.0}})
    records = tuple(
        ImageRecord(
            c.image.image_id, "pair", "pass", c.image.satellite, "pushbroom", json.dumps(c.image.camera), c.image.width, c.image.height,
            c.image.acquired,
        )
        for c in pair
    )  # fmt: skip
    image, point = np.repeat(np.arange(2, dtype=np.int32), points), np.tile(np.arange(points), 2)
    sigmas = [a_priori.parameters[p.name]["sigma"] if p.group == "attitude" else 0.0 for p in PUSHBROOM.parameters]
    thetas = rng.normal(0.0, sigmas, (2, 6))
    seen = [
        PUSHBROOM.project(record.pack()[None], theta[None], Ground.at(truth), rows(points), np.arange(points, dtype=np.int32)).image
        for record, theta in zip(records, thetas, strict=True)
    ]
    measured = np.concatenate(seen) + rng.normal(0.0, 0.5, (2 * points, 2))
    sigma = np.full(2 * points, 0.5)
    ids = np.array([f"point {k:03}" for k in range(points)])
    with CatalogueWriter(tmp_path / "catalogue", CatalogueMetadata("mojave")) as writer:
        writer.write_images(records)
        writer.write_priors(a_priori)
        writer.write_block(Block("pair", records, a_priori, ids[point], image, measured[:, 0], measured[:, 1], sigma, sigma))
    area = shapely.box(-116.24, 35.14, -116.08, 35.25)
    result = fuse(tmp_path / "catalogue", tmp_path / "network", area, tile_km=10.0, overlap_km=4.0)
    assert (result.fused, result.rejected) == (1, ())
    found = submin.open(tmp_path / "network").query(bbox=(-116.24, 35.14, -116.08, 35.25), policy="rigorous")
    assert len(found.ids) > 0.98 * points
    error = found.geocentric - truth[np.searchsorted(ids, found.ids)]
    assert abs(nees_per_dof(error.ravel(), found.covariance) - 1.0) < 4.0 * np.sqrt(2.0 / error.size)
    # attitudes of 10 to 15 microradians from 780 km
    assert 10.0 < np.median(found.ce90) < 30.0


def test_the_margin_of_the_image_is_sampled(pair: list[Compared]) -> None:
    for compared in pair:
        image = compared.image
        cameras = PUSHBROOM.pack(image.camera, image.width, image.height)[None]
        lines = np.array([-0.249 * image.height, 1.249 * image.height])
        seen = PUSHBROOM.localise(cameras, rows(2), np.zeros(2), lines, np.zeros(2), WGS84)
        assert np.isfinite(seen).all()


BAD = [
    ("<PD>1.3", "<PD>x1.3", "GEO/PRINCIPAL_DISTANCE/PD is 'x1.324613900000000e.04'; expected a number"),
    ("<DETROTANGLE>0.0", "<DETROTANGLE>0.5", "DETROTANGLE is 0.5; expected 0"),
    ("<QCS4>1.0", "<QCS4>0.9", "GEO/CAMERA_ATTITUDE/QCS4 is 0.9; expected 1: camera and satellite with the same origin and axes"),
    ("<POLYORDER>-1", "<POLYORDER>3", "POLYORDER is positive; expected a camera without distortion"),
    ("<NUMPOINTS>1318", "<NUMPOINTS>1319", "EPH/EPHEMLISTList has 1318 rows; expected 1319, numbered from 1"),
    ("<FIRSTLINETIME>2014-06-19T18:52:50", "<FIRSTLINETIME>2014-06-19T18:52:49", "line 0 at 1 s from FIRSTLINETIME; expected the same"),
    ("<TLCTIME>2014", "<TLCTIME>in 2014", "IMD/IMAGE/TLCTIME is 'in 2014.*; expected a time as 2014"),
    ("577Z</TLCTIME>", "577</TLCTIME>", "IMD/IMAGE/TLCTIME is .*; expected a time in UTC"),
    ("<CATID>1030010033C4AA00<", "<CATID><", "IMD/IMAGE/CATID is missing"),
    ("<ATTLIST>1.000000000000000e+00 ", "<ATTLIST>1.0 0.5 ", "ATT/ATTLISTList/ATTLIST, entry 1, is '1.0 0.5.*; expected 15 numbers"),
    ("<GEO>", "<GEOX>", "cannot be read as XML"),
    ("GEO>", "GEOX>", "has no section GEO; expected the metadata of a level 1B image"),
    ("BAND_P>", "BAND_N>", "has 0 of GEO/DETECTOR_MOUNTING/BAND_P/DETECTOR_ARRAY; expected one detector line"),
]  # fmt: skip


@pytest.mark.parametrize(("old", "new", "message"), BAD, ids=[new for _, new, _ in BAD])
def test_a_defect_is_named_with_its_file(files: list[Path], tmp_path: Path, old: str, new: str, message: str) -> None:
    content = gzip.decompress(files[0].read_bytes()).decode()
    assert old in content
    bad = tmp_path / "bad.xml"
    bad.write_text(content.replace(old, new))
    with pytest.raises(InputError, match=message) as raised:
        read_worldview(bad)
    assert str(raised.value).startswith(f"{bad}: ")
    assert "\n" not in str(raised.value)


def test_files_that_cannot_be_read(tmp_path: Path) -> None:
    with pytest.raises(InputError, match="no such file; expected the metadata of an image, XML"):
        read_worldview(tmp_path / "nothing.xml")
    (tmp_path / "cut.xml.gz").write_bytes(gzip.compress(b"<isd></isd>")[:-9])
    with pytest.raises(InputError, match="cannot be read as XML"):
        read_worldview(tmp_path / "cut.xml.gz")
