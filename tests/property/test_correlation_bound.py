"""Whatever the covariance and the family: what it is condensed to is a bound for it, by its eigenvalues."""

from __future__ import annotations

from functools import lru_cache
from typing import NamedTuple

import numpy as np
import pytest
import scipy.linalg as la
from hypothesis import example, given, settings
from hypothesis import strategies as st

from benchmarks.bundle import solve
from submin.correlation import (
    FAMILIES,
    CompactCovariance,
    Correlation,
    Family,
    SparseFactor,
    assemble,
    assemble_sparse,
    bounded,
    condense,
    expand,
)
from submin.correlation.assembly import correlation_matrices, own_blocks, symmetric_roots, unwhitened, whitened
from submin.correlation.consistency import MARGIN, consistent_bound, leading, lower_factors
from submin.correlation.fitting import binned, least_inflation, least_squares, typical_points
from submin.errors import InputError, NumericalError
from submin.geodesy import common_axes
from submin.simulation.five_blocks import five_blocks
from submin.simulation.scene import realise
from submin.storage.simulated import scene_blocks

ZERO_FLOOR = [family.name for family in FAMILIES.values() if family.zero_floor]


@pytest.fixture
def short_descents(monkeypatch: pytest.MonkeyPatch) -> None:
    """Fits that stop early: bounds are bounds wherever a descent stops."""
    monkeypatch.setattr("submin.correlation.compact.STEPS", (30,))
    monkeypatch.setattr("submin.correlation.compact.FIRST_STEPS", (15,))


class Points(NamedTuple):
    """Points with a joint covariance."""

    geocentric: np.ndarray
    covariance: np.ndarray

    @property
    def axes(self) -> np.ndarray:
        return common_axes(self.geocentric)


def random_points(seed: int, n: int, images: int, extent: float = 1e5) -> Points:
    """As a network makes them: own parts, and loadings on what images have in common; sigmas and axes of every size."""
    random = np.random.default_rng(seed)
    place = np.array([3.6e6, 3.6e6, 3.8e6]) + extent * random.uniform(-1.0, 1.0, size=(n, 3)) * [1.0, 1.0, 0.2]
    own = random.normal(size=(n, 3, 3)) * random.choice([0.1, 1.0, 10.0])
    loading = random.normal(size=(3 * n, images)) * random.choice([1.0, 30.0], size=images)
    loading += 20.0 * np.tile(random.normal(size=(3, images)), (n, 1))
    return Points(place, la.block_diag(*(own @ np.swapaxes(own, 1, 2) + 0.01 * np.eye(3))) + loading @ loading.T)


def random_functions(family: Family, seed: int, extent: float = 1e5) -> tuple[Correlation, ...]:
    random = np.random.default_rng(seed)
    rest = [random.uniform(*p.search, size=3) for p in family.parameters[1:]]
    reach, correlated = extent * 10.0 ** random.uniform(-1.5, 1.0, size=3), random.choice([0.05, 0.9, 0.999], size=3)
    return tuple(
        Correlation(family, values) for values in zip(correlated.tolist(), reach.tolist(), *(r.tolist() for r in rest), strict=True)
    )


def generalised(points: Points, compact: CompactCovariance) -> np.ndarray:
    """Eigenvalues of the true covariance relative to the bound: none is above one."""
    return np.asarray(la.eigh(points.covariance, expand(compact), eigvals_only=True))


@lru_cache
def five() -> Points:
    solution = solve(scene_blocks(realise(five_blocks(), 0)))
    return Points(solution.geocentric, solution.joint_covariance(np.arange(len(solution.ids))))


@pytest.mark.parametrize("family", FAMILIES.values(), ids=lambda family: family.name)
@settings(max_examples=8)
@given(seed=st.integers(0, 2**31), n=st.integers(3, 14), images=st.integers(1, 12), vectors=st.integers(0, 6))
def test_any_functions_are_made_a_bound(family: Family, seed: int, n: int, images: int, vectors: int) -> None:
    points = random_points(seed, n, images)
    compact = bounded(points.covariance, points.geocentric, points.axes, random_functions(family, seed), vectors)
    ratio = generalised(points, compact)
    assert ratio[-1] <= 1.0
    assert ratio[-1] > 1.0 - 1e-5  # and no larger than it must be
    p_hat = assemble(compact.blocks, points.geocentric, compact.functions, points.axes)
    assert la.eigh(points.covariance, compact.kappa * p_hat, eigvals_only=True)[-1] <= 1.0  # without the vectors
    assert compact.factor <= compact.kappa
    variances = np.diag(expand(compact)).reshape(-1, 3).sum(axis=1) / np.trace(own_blocks(points.covariance), axis1=1, axis2=2)
    np.testing.assert_allclose(compact.inflation, variances, rtol=1e-9)
    assert (variances >= 1.0 - 1e-9).all()


@pytest.mark.parametrize("family", FAMILIES.values(), ids=lambda family: family.name)
def test_five_blocks_are_bounded_by_every_family(family: Family) -> None:
    """Least squares, and again for the factor, which gets smaller; with vectors it enlarges less still."""
    points = five()
    inside = whitened(points.covariance, symmetric_roots(own_blocks(points.covariance))[1], points.axes)
    rough = least_squares(family, binned(inside, points.geocentric))
    fine = least_inflation(rough, inside, points.geocentric, steps=(60,))
    first, second, third = (
        bounded(points.covariance, points.geocentric, points.axes, functions, rank)
        for functions, rank in ((rough, 0), (fine, 0), (fine, 8))
    )
    for compact in (first, second, third):
        assert generalised(points, compact)[-1] <= 1.0
        assert np.linalg.eigvalsh(expand(compact) - points.covariance)[0] > -1e-9
    assert first.kappa > 9.0  # a good fit to the correlations is not a good bound
    assert second.kappa < 0.5 * first.kappa
    assert third.inflation.mean() < 0.8 * second.inflation.mean()
    assert third.kappa == pytest.approx(second.kappa, rel=1e-12)


@settings(max_examples=10)
@given(seed=st.integers(0, 2**31), n=st.integers(3, 12))
@example(seed=60, n=4)
def test_correlations_of_a_family_are_found_again(seed: int, n: int) -> None:
    """A covariance that is made of functions is condensed without loss: kappa is one."""
    points = random_points(seed, n, 3)
    functions = random_functions(FAMILIES["matern-3/2"], seed)
    joint = assemble(own_blocks(points.covariance), points.geocentric, functions, points.axes)
    np.testing.assert_array_equal(joint, joint.T)
    compact = bounded(joint, points.geocentric, points.axes, functions)
    assert compact.kappa == pytest.approx(1.0, abs=1e-7)
    roots, inverse = symmetric_roots(own_blocks(joint))
    inside = whitened(joint, inverse, points.axes)
    np.testing.assert_allclose(inside, la.block_diag(*correlation_matrices(functions, points.geocentric)), atol=1e-9)
    np.testing.assert_allclose(np.einsum("iab,ibc->iac", roots, inverse), np.tile(np.eye(3), (n, 1, 1)), atol=1e-9)
    np.testing.assert_allclose(unwhitened(inside, roots, points.axes), _half(joint, inverse, points.axes), rtol=1e-7, atol=1e-7)


def _half(joint: np.ndarray, inverse: np.ndarray, axes: np.ndarray) -> np.ndarray:
    """A joint covariance, whitened and component-major on the right only."""
    n = len(inverse)
    return np.einsum("kjb,cd,jdb->kcj", joint.reshape(3 * n, n, 3), axes, inverse).reshape(3 * n, 3 * n)


def test_the_sum_of_the_rest_is_bounded_in_every_direction_that_is_kept() -> None:
    """Eigenvalues against the bound: those of the kept directions become one, the rest are the ratio to the factor."""
    points = five()
    functions = random_functions(FAMILIES["exponential"], 5)
    all_of_them = bounded(points.covariance, points.geocentric, points.axes, functions, 0)
    p_hat = assemble(all_of_them.blocks, points.geocentric, functions, points.axes)
    values = la.eigh(points.covariance, p_hat, eigvals_only=True)[::-1]
    compact = bounded(points.covariance, points.geocentric, points.axes, functions, 5)
    assert compact.kappa == pytest.approx((1.0 + MARGIN) * values[0], rel=1e-9)
    assert compact.factor == pytest.approx((1.0 + MARGIN) * values[5], rel=1e-9)
    expected = np.sort(np.concatenate([np.ones(5), values[5:] / values[5]]))
    np.testing.assert_allclose(generalised(points, compact), expected, rtol=1e-6)


def test_lanczos_and_whole_solution_agree(monkeypatch: pytest.MonkeyPatch) -> None:
    points = random_points(3, 40, 9)
    inside = whitened(points.covariance, symmetric_roots(own_blocks(points.covariance))[1], points.axes)
    factors = lower_factors(correlation_matrices(random_functions(FAMILIES["wendland"], 1), points.geocentric))
    whole = leading(inside, factors, 6)
    monkeypatch.setattr("submin.correlation.consistency.DENSE", 10)
    some = leading(inside, factors, 6)
    np.testing.assert_allclose(some[0], whole[0], rtol=1e-9)
    np.testing.assert_allclose(np.abs((some[1] * whole[1]).sum(axis=0)), (whole[1] ** 2).sum(axis=0), rtol=1e-6)


@pytest.mark.parametrize("family", ZERO_FLOOR)
@settings(max_examples=8)
@given(seed=st.integers(0, 2**31), n=st.integers(2, 30))
def test_sparse_is_dense_without_the_zeros(family: str, seed: int, n: int) -> None:
    points = random_points(seed, n, 4)
    functions, blocks = random_functions(FAMILIES[family], seed), own_blocks(points.covariance)
    dense = assemble(blocks, points.geocentric, functions, points.axes)
    sparse = assemble_sparse(blocks, points.geocentric, functions, points.axes)
    np.testing.assert_allclose(sparse.toarray(), dense, rtol=1e-12, atol=1e-12 * np.abs(dense).max())
    chord = np.linalg.norm(points.geocentric[:, None] - points.geocentric, axis=2)
    assert sparse.nnz == 9 * (chord <= max(function.floor for function in functions)).sum()
    factor = SparseFactor.of(sparse)
    right = np.random.default_rng(seed).normal(size=(3 * n, 2))
    np.testing.assert_allclose(dense @ factor.solve(right), right, atol=1e-6)
    assert factor.triangle == (sparse.nnz + 3 * n) // 2 <= factor.fill


def test_sparse_needs_a_floor_and_a_definite_matrix() -> None:
    points = random_points(1, 5, 2)
    with pytest.raises(InputError, match="family 'exponential' is zero at no distance"):
        assemble_sparse(own_blocks(points.covariance), points.geocentric, random_functions(FAMILIES["exponential"], 1), points.axes)
    sparse = assemble_sparse(own_blocks(points.covariance), points.geocentric, random_functions(FAMILIES["askey"], 1), points.axes).tolil()
    sparse[4, 4] = -sparse[4, 4]
    with pytest.raises(NumericalError, match="expected a positive definite matrix"):
        SparseFactor.of(sparse.tocsc())


def test_a_floor_is_kept(short_descents: None) -> None:
    points = five()
    compact = condense(points.covariance, points.geocentric, points.axes, "wendland", rank=8, floor=60e3)
    assert max(function.floor for function in compact.functions) <= 60e3 * (1.0 + 1e-12)
    assert generalised(points, compact)[-1] <= 1.0


def test_auto_is_no_worse_than_one_family_and_can_be_asked_for_a_floor(short_descents: None) -> None:
    points = Points(five().geocentric[:20], five().covariance[:60, :60])
    best = condense(points.covariance, points.geocentric, points.axes)
    assert best.kappa <= 1.05 * condense(points.covariance, points.geocentric, points.axes, "spherical").kappa
    assert generalised(points, best)[-1] <= 1.0
    assert condense(points.covariance, points.geocentric, points.axes, floor=80e3).family.zero_floor


def test_many_points_are_fitted_by_some_of_them_and_bounded_by_all(short_descents: None) -> None:
    points = random_points(8, 160, 15)
    rows = typical_points(points.geocentric)
    assert len(rows) <= 120 and len(np.unique(rows)) == len(rows)
    chord = np.linalg.norm(points.geocentric[:, None] - points.geocentric, axis=2) + 1e9 * np.eye(160)
    assert np.isin(chord.argmin(axis=1)[rows], rows).mean() > 0.5  # neighbours are among them
    compact = condense(points.covariance, points.geocentric, points.axes, "exponential", rank=3)
    assert generalised(points, compact)[-1] <= 1.0


@pytest.mark.parametrize(
    ("changes", "says"),
    [
        ({"family": "tent"}, "positive definite on a line only"),
        ({"family": "sinc"}, "family is 'sinc'"),
        ({"rank": -1}, "rank is -1; expected 0 or more"),
        ({"rank": 15}, "rank is 15; expected 0 to 14 for 5 points"),
        ({"floor": 0.0}, "floor is 0 m; expected a positive number"),
        (
            {"family": "gaussian", "floor": 1e4},
            "family 'gaussian' is zero at no distance; expected auto or one of spherical, wendland, askey",
        ),
    ],
)
def test_what_cannot_be_asked(changes: dict[str, object], says: str) -> None:
    points = random_points(2, 5, 2)
    with pytest.raises(InputError, match=says):
        condense(points.covariance, points.geocentric, points.axes, **changes)


def test_too_few_and_too_many_points() -> None:
    points = random_points(2, 2, 2)
    with pytest.raises(InputError, match="2 points; expected 3 or more"):
        condense(points.covariance, points.geocentric, points.axes, "exponential")
    with pytest.raises(InputError, match=r"more than 3,000 points.*export by --bbox, --aoi or --tile, or thin with --max-points"):
        condense(np.empty((0, 0)), np.empty((3001, 3)), np.eye(3), "exponential")


def test_a_point_without_error_is_refused() -> None:
    points = random_points(2, 4, 2)
    joint = points.covariance.copy()
    joint[3:6] = joint[:, 3:6] = 0.0
    with pytest.raises(NumericalError, match="point 1: its covariance has the eigenvalues"):
        condense(joint, points.geocentric, points.axes, "exponential")


def test_correlations_that_are_singular_are_refused() -> None:
    """Two points at one place, wholly correlated."""
    place = np.array([[3.6e6, 3.6e6, 3.8e6], [3.6e6, 3.6e6, 3.8e6], [3.61e6, 3.6e6, 3.8e6]])
    functions = (Correlation(FAMILIES["exponential"], (1.0, 1e5)),) * 3
    with pytest.raises(NumericalError, match="not positive definite"):
        consistent_bound(np.eye(9), correlation_matrices(functions, place))
