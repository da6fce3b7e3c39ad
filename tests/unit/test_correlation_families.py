"""Correlation functions: where they are positive definite, and that what is not is refused."""

from __future__ import annotations

from typing import Any

import numpy as np
import pytest
from scipy.integrate import simpson
from scipy.spatial.distance import pdist, squareform
from scipy.special import j0

from submin.correlation.families import FAMILIES, Correlation, Family, family_named
from submin.errors import InputError

ROUND_OFF = 1e-12


def least_eigenvalue(values: np.ndarray) -> float:
    """Of the correlation matrix whose entries beside the diagonal are these, pair by pair."""
    matrix = squareform(values)
    np.fill_diagonal(matrix, 1.0)
    return float(np.linalg.eigvalsh(matrix)[0])


def grid(side: int, dimension: int, spacing: float = 1.0) -> np.ndarray:
    axes = np.meshgrid(*[spacing * np.arange(side)] * dimension)
    return np.column_stack([axis.ravel() for axis in axes])


def extremes(family: Family) -> list[tuple[float, ...]]:
    """Values of all parameters but the length at the ends of what a fit looks through; the correlated part is one."""
    rest = family.parameters[1:]
    cases = [tuple(p.start for p in rest)]
    cases += [tuple(p.search[end] if p is q else p.start for p in rest) for q in rest for end in (0, 1)]
    return cases


@pytest.mark.parametrize("family", FAMILIES.values(), ids=lambda family: family.name)
def test_every_family_is_positive_definite_in_space(family: Family) -> None:
    random = np.random.default_rng(4)
    for points in (grid(6, 3), grid(12, 2), random.normal(size=(150, 3)), np.array([[1.0, 1.0, 0.05]]) * random.normal(size=(150, 3))):
        chord = pdist(points)
        for rest in extremes(family):
            for reach in (0.3, 0.7, 1.0, 1.4, 2.0, 3.0, 8.0):
                rho = Correlation(family, (1.0, reach, *rest))
                assert least_eigenvalue(rho(chord)) > -ROUND_OFF * len(points)


@pytest.mark.parametrize("family", FAMILIES.values(), ids=lambda family: family.name)
def test_formula_floor_and_value_at_zero(family: Family) -> None:
    rho = Correlation(family, (0.9, 700.0, *(p.start for p in family.parameters[1:])))
    d = np.linspace(0.0, 3000.0, 301)
    numpy_names = {name: getattr(np, name) for name in ("exp", "sqrt", "cos", "pi", "minimum", "maximum")}
    stated = eval(family.formula, {"__builtins__": {}}, {**numpy_names, **rho.parameters, "d": d})
    np.testing.assert_allclose(rho(d), stated, rtol=1e-13, atol=1e-15)
    assert rho(np.zeros(1))[0] == pytest.approx(0.9)
    assert (np.abs(rho(d)) <= 0.9 + 1e-15).all()
    if family.zero_floor:
        assert rho.floor == 700.0
        assert (rho(d[d >= 700.0]) == 0.0).all() and (rho(d[d < 690.0]) > 0.0).all()
    else:
        assert rho.floor == np.inf


def test_the_planar_tent_is_refused_because_it_is_indefinite() -> None:
    chord = pdist(grid(8, 2, 0.7))
    assert least_eigenvalue(np.maximum(1.0 - chord, 0.0)) == pytest.approx(-0.09, abs=0.005)
    line = pdist(grid(64, 1, 0.7))
    assert least_eigenvalue(np.maximum(1.0 - line, 0.0)) > -ROUND_OFF
    for replacement in ("askey", "spherical"):
        rho = Correlation(family_named(replacement), (1.0, 1.0, 2.0) if replacement == "askey" else (1.0, 1.0))
        assert least_eigenvalue(rho(chord)) > 0.0
    x, y = (pdist(grid(8, 2, 0.7)[:, [k]]) for k in (0, 1))
    assert least_eigenvalue(np.maximum(1.0 - x, 0.0) * np.maximum(1.0 - y, 0.0)) > 0.0
    for name in ("tent", "linear"):
        with pytest.raises(InputError, match=r"positive definite on a line only.*expected 'askey' or 'spherical'.*product"):
            family_named(name)


def test_csm_beyond_its_limit_is_indefinite_in_the_plane() -> None:
    csm = family_named("csm")
    fine = pdist(grid(24, 2, 0.7))
    assert least_eigenvalue(csm.shape(fine, 1.0, 0.0, 10.0)) < -0.01
    assert least_eigenvalue(csm.shape(fine, 1.0, 0.0, 8.49)) > 0.0
    with pytest.raises(InputError, match=r"csm: b is 10; expected a number above -1 to 8.49: .* not positive definite in the plane"):
        Correlation(csm, (1.0, 1.0, 0.0, 10.0), dimension=2)
    assert Correlation(csm, (1.0, 1.0, 0.0, 10.0), dimension=1).parameters["b"] == 10.0


@pytest.mark.parametrize("dimension", [1, 2, 3])
def test_limit_of_csm_is_where_its_spectrum_turns_negative(dimension: int) -> None:
    """The limits are rounded down to two places: at the limit nothing is negative, and a hundredth above something is."""
    beta = FAMILIES["csm"].parameters[2].valid[dimension - 1].high
    h, k = np.linspace(0.0, 60.0, 30_001), np.linspace(1.0, 4.0, 61)
    kernel = {1: np.cos, 2: lambda x: h * j0(x), 3: lambda x: h * np.sin(x)}[dimension]

    def spectrum(b: float) -> np.ndarray:
        f = FAMILIES["csm"].shape(h, 1.0, 0.0, b)
        return np.array([simpson(f * kernel(wave * h), x=h) for wave in k])

    assert spectrum(beta).min() > 0.0 > spectrum(beta + 0.01).min()


@pytest.mark.parametrize(("dimension", "limit"), [(2, 2.0 * np.pi), (3, 2.0 * np.pi * np.sqrt(3.0))])
def test_limit_of_the_damped_cosine(dimension: int, limit: float) -> None:
    family = family_named("damped-cosine")
    assert family.parameters[1].valid[dimension - 1].low == pytest.approx(limit, rel=1e-15)
    assert any(
        least_eigenvalue(family.shape(pdist(grid(side, dimension, spacing)), 1.0, 0.5 * limit)) < -1e-3
        for side, spacing in ((8, 0.5), (8, 1.0), (8, 1.5))
    )
    with pytest.raises(InputError, match="damped-cosine: q is"):
        Correlation(family, (1.0, 1.0, 0.99 * limit), dimension)


@pytest.mark.parametrize(
    ("name", "values", "says"),
    [
        ("askey", (1.0, 1.0, 1.9), "askey: l is 1.9; expected a number from 2: else .* in space"),
        ("exponential", (1.1, 1.0), "A is 1.1; expected a number above 0 to 1"),
        ("exponential", (0.0, 1.0), "A is 0;"),
        ("gaussian", (1.0, 0.0), "D is 0; expected a number above 0"),
        ("gaussian", (1.0, np.nan), "D is nan"),
        ("powered-exponential", (1.0, 1.0, 2.1), "g is 2.1; expected a number above 0 to 2"),
        ("cauchy", (1.0, 1.0, -1.0), "n is -1"),
        ("csm", (1.0, 1.0, 1.0, 0.0), "a is 1; expected a number from 0 and below 1"),
        ("csm", (1.0, 1.0, 0.0, 7.5), "b is 7.5; expected a number above -1 to 7.48"),
        ("exponential", (1.0,), "1 values; expected 2: A, D"),
    ],
)
def test_parameters_out_of_range(name: str, values: tuple[float, ...], says: str) -> None:
    with pytest.raises(InputError, match=says):
        Correlation(family_named(name), values)


def test_unknown_family_and_dimension() -> None:
    with pytest.raises(InputError, match="family is 'sinc'; expected auto or one of exponential, "):
        family_named("sinc")
    arguments: dict[str, Any] = {"family": family_named("exponential"), "values": (1.0, 1.0), "dimension": 4}
    with pytest.raises(InputError, match="dimension is 4; expected 1, 2 or 3"):
        Correlation(**arguments)
