"""The a priori factor against the covariance written out by hand, element by element."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from numpy.typing import NDArray

from submin.adjustment.elimination import Sums
from submin.adjustment.estimation import estimate_images
from submin.adjustment.priors import RELEASE_FACTOR, APriori, ImagePrior, Uncertainty, correlation_factor, prior_factor
from submin.errors import InputError
from submin.sensors import Parameter, sensor_named

Array = NDArray[np.float64]
RPC = sensor_named("rpc")

P, BIAS = 6, (0, 3)
MODELS = (
    APriori(10.0, 1.0, 0.5, "none", 0.0),
    APriori(8.0, 0.7, 0.0, "fixed", 0.4),
    APriori(4.0, 2.0, 0.3, "exponential", 30.0),
    APriori(12.0, 0.5, 0.8, "gaussian", 20.0),
    APriori(10.0, 1.0, 1.0, "fixed", 0.9),
)


def images(blocks: int = 3, each: int = 3, model: APriori | None = None) -> list[ImagePrior]:
    """Images of several blocks over two passes, the blocks' models all different unless one is given."""
    return [
        ImagePrior(f"block {b}", f"pass {(b + k) % 2}", 100.0 * b + 7.0 * k, model or MODELS[b % len(MODELS)], RPC.parameters)
        for b in range(blocks)
        for k in range(each)
    ]


def correlation_by_hand(model: APriori, seconds: float) -> float:
    """Correlation of two different images of a block, so many seconds apart."""
    return {
        "none": 0.0,
        "fixed": model.correlation_parameter,
        "exponential": float(np.exp(-seconds / model.correlation_parameter)) if model.correlation_parameter else 0.0,
        "gaussian": float(np.exp(-((seconds / model.correlation_parameter) ** 2))) if model.correlation_parameter else 0.0,
    }[model.correlation]


def covariance_by_hand(priors: list[ImagePrior]) -> Array:
    """Q (m p, m p), one element after another."""
    m = len(priors)
    q = np.zeros((m, P, m, P))
    for i, one in enumerate(priors):
        for k, other in enumerate(priors):
            for c in range(P):
                own = other_own = 0.0
                for image, first in ((one, True), (other, False)):
                    model = image.a_priori
                    sigma = model.bias_px * (1.0 - model.common_to_pass) ** 0.5 if c in BIAS else model.drift_px
                    sigma *= 100.0 if image.released else 1.0
                    own, other_own = (sigma, other_own) if first else (own, sigma)
                if i == k:
                    q[i, c, k, c] += own * own
                elif one.block_id == other.block_id:
                    q[i, c, k, c] += own * other_own * correlation_by_hand(one.a_priori, abs(one.seconds - other.seconds))
                if one.pass_id == other.pass_id and c in BIAS:
                    shared = [image.a_priori.bias_px * image.a_priori.common_to_pass**0.5 for image in (one, other)]
                    q[i, c, k, c] += shared[0] * shared[1]
    return q.reshape(m * P, m * P)


def covariance(priors: list[ImagePrior]) -> Array:
    factor = prior_factor(priors, P)
    return np.asarray((factor @ factor.T).toarray())


def assert_equal_covariances(found: Array, expected: Array, relative: float = 1e-12) -> None:
    sigma = np.sqrt(np.diag(expected))
    np.testing.assert_allclose(found / np.outer(sigma, sigma), expected / np.outer(sigma, sigma), rtol=0.0, atol=relative)


def test_one_image_has_the_sigmas_that_were_given() -> None:
    found = covariance([ImagePrior("b", "p", 0.0, APriori(10.0, 1.0, 0.36), RPC.parameters)])
    np.testing.assert_allclose(found, np.diag([100.0, 1.0, 1.0, 100.0, 1.0, 1.0]), rtol=1e-14, atol=1e-14)


@pytest.mark.parametrize("model", MODELS, ids=[f"{m.correlation}-{m.common_to_pass}" for m in MODELS])
def test_factor_gives_the_covariance_written_by_hand(model: APriori) -> None:
    priors = images(blocks=2, each=4, model=model)
    assert_equal_covariances(covariance(priors), covariance_by_hand(priors))


def test_blocks_of_different_models_share_a_pass() -> None:
    priors = images(blocks=5, each=3)
    by_hand = covariance_by_hand(priors)
    assert_equal_covariances(covariance(priors), by_hand)
    # shift of the first images of blocks 2 and 3 shares a pass with other blocks, and line never goes with sample
    assert by_hand[6 * 6, 8 * 6] != 0.0 and by_hand[6 * 6, 0] != 0.0
    assert by_hand[6 * 6, 6 * 6 + 3] == 0.0


@pytest.mark.parametrize("model", MODELS, ids=[m.correlation for m in MODELS])
def test_images_of_a_block_may_have_pixels_of_their_own(model: APriori) -> None:
    in_metres = replace(model, bias_m=15.0)
    priors = [replace(image, a_priori=in_metres.in_pixels((2.1, 3.5)[k % 2])) for k, image in enumerate(images(3, 4, model))]
    assert {image.a_priori.bias_px for image in priors if image.a_priori} == {7.14, 4.29}
    assert_equal_covariances(covariance(priors), covariance_by_hand(priors))


def test_a_shift_in_metres_is_metres_until_it_is_in_pixels() -> None:
    stated = APriori(bias_m=15.0, drift_px=0.5)
    bias, drift = RPC.parameters[0], RPC.parameters[1]
    assert (stated.of(bias).sigma, stated.of(drift).sigma) == (15.0, 0.5)
    found = stated.in_pixels(2.5)
    assert (found.of(bias).sigma, found.of(drift).sigma, found.bias_m) == (6.0, 0.5, None)
    assert APriori().in_pixels(2.5) == APriori()
    assert APriori.from_mapping(stated.to_mapping()) == stated
    assert "bias_m" not in APriori().to_mapping()
    with pytest.raises(InputError, match=r"bias_m is 0.0; expected a positive number of metres"):
        APriori(bias_m=0.0)


def test_order_of_images_is_free() -> None:
    priors = images(blocks=3, each=3)
    order = np.random.default_rng(1).permutation(len(priors))
    rows = (order[:, None] * P + np.arange(P)).ravel()
    assert_equal_covariances(covariance([priors[i] for i in order]), covariance(priors)[np.ix_(rows, rows)])


@settings(max_examples=30, deadline=None, derandomize=True)
@given(st.integers(0, 2**32 - 1), st.integers(1, 8))
def test_subset_of_images_has_the_marginal_of_the_whole(seed: int, count: int) -> None:
    priors = images(blocks=5, each=3)
    chosen = np.sort(np.random.default_rng(seed).choice(len(priors), count, replace=False))
    rows = (chosen[:, None] * P + np.arange(P)).ravel()
    assert_equal_covariances(covariance([priors[i] for i in chosen]), covariance(priors)[np.ix_(rows, rows)])


def test_images_seconds_apart_keep_their_covariance() -> None:
    model = APriori(10.0, 1.0, 0.5, "gaussian", 5000.0)
    priors = [ImagePrior("b", f"pass {k}", 5.0 * k, model, RPC.parameters) for k in range(6)]
    # so close to singular that round-off makes a computed eigenvalue negative: a plain Cholesky factor does not exist
    correlation = model.of(RPC.parameters[0]).correlations(np.arange(0.0, 30.0, 5.0))
    assert np.linalg.eigvalsh(correlation).min() < 0.0
    factor = correlation_factor(correlation)
    assert np.isfinite(factor).all()
    np.testing.assert_allclose(factor @ factor.T, correlation, rtol=0.0, atol=1e-14)
    assert np.isfinite(prior_factor(priors, P).toarray()).all()
    assert_equal_covariances(covariance(priors), covariance_by_hand(priors), 1e-14)


def test_nearly_equal_images_differ_as_much_as_the_model_says() -> None:
    model = APriori(10.0, 1.0, 0.0, "gaussian", 5000.0)
    priors = [ImagePrior("b", "p", 5.0 * k, model, RPC.parameters) for k in range(6)]
    by_image = prior_factor(priors, P).toarray().reshape(6, P, -1)[:, 0]
    for i in range(6):
        for k in range(i):
            expected = 2.0 * 100.0 * -np.expm1(-((5.0 * (i - k) / 5000.0) ** 2))
            # differences come from the factor, not from a covariance of 100 less another: they keep their leading digits
            assert np.sum((by_image[i] - by_image[k]) ** 2) == pytest.approx(expected, rel=1e-7)


def test_released_image_gets_a_hundred_times_its_own_sigmas() -> None:
    assert RELEASE_FACTOR == 100.0
    priors = images(blocks=2, each=3, model=APriori(10.0, 1.0, 0.0))
    released = [replace(p, released=k in (1, 4)) for k, p in enumerate(priors)]
    assert_equal_covariances(covariance(released), covariance_by_hand(released))


@pytest.mark.parametrize("model", MODELS[1:4], ids=[m.correlation for m in MODELS[1:4]])
def test_sigmas_of_a_released_image_of_a_correlated_block(model: APriori) -> None:
    priors = images(blocks=1, each=3, model=replace(model, common_to_pass=0.0))
    released = [replace(priors[0], released=True), *priors[1:]]
    np.testing.assert_allclose(np.diag(covariance(released)), np.diag(covariance_by_hand(released)), rtol=1e-12)


@pytest.mark.parametrize("model", MODELS, ids=[f"{m.correlation}-{m.common_to_pass}" for m in MODELS])
def test_released_image_tells_nothing_of_its_neighbours(model: APriori) -> None:
    # its position is left to the network: when tie points fix it relative to a neighbour, the neighbour is known no better for it
    priors = images(blocks=1, each=3, model=replace(model, common_to_pass=0.0))
    priors[0] = replace(priors[0], released=True)
    q = covariance(priors)
    difference = np.zeros(len(q))
    difference[0], difference[P] = 1.0, -1.0
    gain = q @ difference
    posterior = q - np.outer(gain, gain) / (difference @ gain)
    assert posterior[P, P] > 0.99 * q[P, P]


@pytest.mark.parametrize("common", [0.0, 0.5, 1.0])
def test_released_image_is_free_of_its_pass(common: float) -> None:
    priors = images(blocks=1, each=3, model=APriori(10.0, 1.0, common))
    q = covariance([replace(priors[0], released=True), *priors[1:]])
    others = np.r_[P : len(q)]
    conditional = q[0, 0] - q[0, others] @ np.linalg.pinv(q[np.ix_(others, others)]) @ q[others, 0]
    # wide enough for a camera that is off by a hundred times what was believed of it
    assert np.sqrt(conditional) > 500.0


def test_nothing_is_known_of_no_images() -> None:
    assert prior_factor([], P).shape == (0, 0)


def test_model_survives_its_mapping() -> None:
    for model in MODELS:
        assert APriori.from_mapping(model.to_mapping()) == model
    assert APriori.from_mapping({}) == APriori()
    assert APriori.from_mapping({"bias_px": "12.5"}).bias_px == 12.5


@pytest.mark.parametrize(
    ("values", "words"),
    [
        ({"bias_px": 0.0}, "bias_px is 0.0; expected a positive number of pixels"),
        ({"bias_px": float("nan")}, "bias_px is nan"),
        ({"drift_px": -1.0}, "drift_px is -1.0; expected a positive number of pixels"),
        ({"drift_px": float("inf")}, "drift_px is inf"),
        ({"common_to_pass": 1.1}, "common_to_pass is 1.1; expected a part of the variance, 0 to 1"),
        ({"common_to_pass": -0.1}, "common_to_pass is -0.1"),
        ({"correlation": "linear"}, "correlation is 'linear'; expected one of none, fixed, exponential, gaussian"),
        ({"correlation": "fixed", "correlation_parameter": 1.0}, "fixed correlation is 1.0; expected 0 to below 1"),
        ({"correlation": "fixed", "correlation_parameter": -0.2}, "fixed correlation is -0.2"),
        ({"correlation": "exponential"}, "time constant is 0.0; expected a positive number of seconds"),
        ({"correlation": "gaussian", "correlation_parameter": float("nan")}, "time constant is nan"),
        ({"bias": 3.0}, "unknown key 'bias'; expected some of bias_px, drift_px"),
        ({"bias_px": "ten"}, "holds something that is not a number"),
        ({"drift_px": None}, "holds something that is not a number"),
    ],
)
def test_bad_models_are_refused(values: dict[str, Any], words: str) -> None:
    with pytest.raises(InputError, match=words):
        APriori.from_mapping(values)


@pytest.mark.parametrize("correlation", ["exponential", "gaussian"])
def test_correlation_in_time_needs_times(correlation: str) -> None:
    model = APriori(correlation=correlation, correlation_parameter=5.0)
    with pytest.raises(InputError, match=r"temporal correlation needs the time of every image .*acquired"):
        prior_factor([ImagePrior("b", "p", seconds, model, RPC.parameters) for seconds in (0.0, np.nan)], P)


def test_times_may_be_unknown_where_they_are_not_needed() -> None:
    priors = [ImagePrior("b", "p", np.nan, APriori(10.0, 1.0, 0.0, "fixed", 0.4), RPC.parameters) for _ in range(2)]
    assert_equal_covariances(covariance(priors), covariance_by_hand(priors))


# Parameters of any sensor

ATTITUDE = tuple(Parameter(f"attitude {axis}", "rad", "attitude", 2e-5) for axis in ("alpha", "beta"))
FRAME = (Parameter("in track", "m", "position", 5.0), *ATTITUDE, Parameter("focal length", "mm", "focal length", 0.1))


def stated(model: APriori, parameters: tuple[Parameter, ...] = FRAME) -> dict[str, Uncertainty]:
    return {parameter.name: model.of(parameter) for parameter in parameters}


def test_a_sensor_states_what_the_priors_do_not() -> None:
    found = stated(APriori(correlation="fixed", correlation_parameter=0.3))
    assert {name: u.sigma for name, u in found.items()} == {
        "in track": 5.0, "attitude alpha": 2e-5, "attitude beta": 2e-5, "focal length": 0.1
    }  # fmt: skip
    assert {(u.correlation, u.correlation_parameter, u.common_to_pass) for u in found.values()} == {("fixed", 0.3, 0.0)}


def test_a_name_goes_before_its_group_and_both_before_the_sensor() -> None:
    found = stated(APriori(parameters={
        "attitude": {"sigma": 1e-4, "correlation": "gaussian", "correlation_parameter": 200},
        "attitude beta": {"sigma": 3e-4, "common_to_pass": 0.25},
        "focal length": {"sigma": 0},
    }))  # fmt: skip
    assert found["attitude alpha"] == Uncertainty(1e-4, 0.0, "gaussian", 200.0)
    assert found["attitude beta"] == Uncertainty(3e-4, 0.25, "gaussian", 200.0)
    assert found["focal length"].sigma == 0.0 and found["in track"].sigma == 5.0


def test_each_parameter_has_its_own_correlation_in_time() -> None:
    model = APriori(parameters={
        "in track": {"sigma": 6.0, "correlation": "gaussian", "correlation_parameter": 2000.0},
        "attitude": {"correlation": "exponential", "correlation_parameter": 100.0},
        "attitude beta": {"common_to_pass": 0.5},
        "focal length": {"sigma": 0.0},
    })  # fmt: skip
    seconds = (0.0, 80.0, 200.0)
    priors = [ImagePrior("b", f"pass {k // 2}", t, model, FRAME) for k, t in enumerate(seconds)]
    q = np.asarray((prior_factor(priors, 5) @ prior_factor(priors, 5).T).toarray()).reshape(3, 5, 3, 5)
    dt = np.abs(np.subtract.outer(seconds, seconds))
    np.testing.assert_allclose(q[:, 0, :, 0], 36.0 * np.exp(-((dt / 2000.0) ** 2)), rtol=1e-12)
    np.testing.assert_allclose(q[:, 1, :, 1], 4e-10 * np.exp(-dt / 100.0), rtol=1e-12)
    same_pass = np.array([[1, 1, 0], [1, 1, 0], [0, 0, 1]])
    np.testing.assert_allclose(q[:, 2, :, 2], 2e-10 * np.exp(-dt / 100.0) + 2e-10 * same_pass, rtol=1e-12)
    assert not q[:, 3:].any() and not q[:, 0, :, 1:].any(), "held, padded, and never correlated with one another"


@pytest.mark.parametrize(("correction", "adjustable"), [("shift", (0, 3)), ("shift+drift", (0, 2, 3, 5)), ("affine", range(6))])
def test_corrections_of_an_rpc(correction: str, adjustable: Sequence[int]) -> None:
    q = covariance([ImagePrior("b", "p", 0.0, APriori(10.0, 2.0, 0.5, correction=correction), RPC.parameters)])
    sigmas = np.array([10.0, 2.0, 2.0, 10.0, 2.0, 2.0])
    np.testing.assert_allclose(np.diag(q), np.where(np.isin(np.arange(P), list(adjustable)), sigmas**2, 0.0), rtol=1e-14)


def test_sensors_of_a_block_are_not_correlated_with_each_other() -> None:
    model = APriori(10.0, 1.0, 0.0, "fixed", 0.5)
    priors = [ImagePrior("b", "p", 0.0, model, parameters) for parameters in (RPC.parameters, FRAME, RPC.parameters, FRAME)]
    q = covariance(priors).reshape(4, P, 4, P)
    assert q[0, 0, 2, 0] == pytest.approx(50.0) and q[1, 0, 3, 0] == pytest.approx(12.5)
    assert not q[0, :, 1].any() and not q[0, :, 3].any()


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"parameters": {"position": 6.0}}, "'position' is 6.0; expected an object with some of sigma, common_to_pass"),
        ({"parameters": {"position": {"sigm": 6.0}}}, "'position': unknown key 'sigm'; expected some of sigma"),
        ({"parameters": {"position": {"sigma": -6.0}}}, "'position': sigma is -6.0; expected 0"),
        ({"parameters": {"position": {"sigma": "six"}}}, "'position' holds something that is not a number"),
        ({"parameters": {"rate": {"correlation": "fixed", "correlation_parameter": 1.0}}}, "'rate': fixed correlation is 1.0"),
        ({"parameters": [1]}, "parameters is"),
        ({"correction": "cubic"}, "correction is 'cubic'; expected one of shift, shift\\+drift, affine"),
    ],
)
def test_entries_by_parameter_that_cannot_be(values: dict[str, Any], message: str) -> None:
    with pytest.raises(InputError, match=message):
        APriori.from_mapping(values)


def test_a_mapping_comes_back_as_the_same_model() -> None:
    model = APriori(8.0, 0.5, correction="shift", parameters={"rate": {"sigma": 1e-6}})
    assert APriori.from_mapping(model.to_mapping()) == model
    assert set(APriori().to_mapping()) == {"bias_px", "drift_px", "common_to_pass", "correlation", "correlation_parameter"}


def test_nearly_equal_images_are_adjusted_to_full_accuracy() -> None:
    """Six images within 25 s, T = 5,000 s: the correlation has condition 1e27. Against the same adjustment with 80 digits."""
    seconds, sigma, t = 5.0 * np.arange(6), 6.0, 5000.0
    model = APriori(parameters={"in track": {"sigma": sigma, "correlation": "gaussian", "correlation_parameter": t}})
    track = (FRAME[0],)
    priors = [ImagePrior("b", "p", s, model, track) for s in seconds]
    rng = np.random.default_rng(4)
    design, y = rng.normal(size=(40, 6)), rng.normal(0.0, 3.0, 40)
    information = design.T @ design
    estimate = estimate_images(Sums(np.tril(information), design.T @ y, float(y @ y), 40), prior_factor(priors, 1), 1)

    with mpmath.workdps(80):
        dt = mpmath.matrix(6, 6)
        for i in range(6):
            for k in range(6):
                dt[i, k] = mpmath.mpf(sigma) ** 2 * mpmath.exp(-(((mpmath.mpf(seconds[i]) - mpmath.mpf(seconds[k])) / t) ** 2))
        a = mpmath.matrix(design.tolist())
        gain = dt * a.T * mpmath.inverse(a * dt * a.T + mpmath.eye(40))
        expected = np.array((dt - gain * a * dt).tolist(), dtype=np.float64)
        theta = np.array((gain * mpmath.matrix(y.tolist())).tolist(), dtype=np.float64).ravel()
    # 1 - 1e-6 in float64, the correlation of neighbours, is known to 1e-10 of its distance from 1: there is no more to be had
    np.testing.assert_allclose(estimate.covariance, expected, rtol=1e-10)
    np.testing.assert_allclose(estimate.theta.ravel(), theta, rtol=1e-10)
    # a plain inverse of the a priori covariance loses all of it
    q = np.asarray(sigma**2 * np.exp(-((np.subtract.outer(seconds, seconds) / t) ** 2)))
    naive = np.linalg.inv(np.linalg.inv(q) + information)
    assert np.abs(naive / expected - 1.0).max() > 1e-6
