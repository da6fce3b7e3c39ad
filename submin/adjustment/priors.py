"""A priori model of the images' adjustable parameters, as a factor: what is believed of a camera before any measurement.

The correction of an image is the sum of a part of its own and a part common to all images of its pass. Both are written by whitened vectors
``u`` with covariance I (docs/mathematics.md, "Parameter vectors are held whitened"): ``theta = K u``, so the a priori covariance is ``Q =
K K'`` and
``Q^-1`` is never formed. Correlations between the images of a block are factored as *correlation* matrices, of which the nearly singular
ones
(images seconds apart) lose nothing: a negative computed eigenvalue is clipped to zero, which only says that two corrections are equal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.errors import InputError

Array = NDArray[np.float64]

RELEASE_FACTOR = 100.0
"""Sigmas of an image whose camera was found to be bad are multiplied by this, and it is correlated with no other: its position is left to
the network (decision 004)."""

CORRELATION_MODELS = ("none", "fixed", "exponential", "gaussian")


@dataclass(frozen=True)
class APriori:
    """A priori sigmas of an image-space correction and how they are shared.

    Parameters
    ----------
    bias_px : float
        Total sigma of the shift of an image, in sample and in line each, pixels.
    drift_px : float
        Sigma of each of the four drift parameters: the shift at the edge of the image, pixels.
    common_to_pass : float
        Part (0 to 1) of the *variance* of the shift that all images of one pass share.
    correlation : str
        Correlation of the images' own parts within a block: ``none``, ``fixed`` (the same between any two), ``exponential``
        ``exp(-dt/T)`` or ``gaussian`` ``exp(-(dt/T)^2)`` in the time between the images.
    correlation_parameter : float
        For ``fixed`` the correlation (0 to below 1); for the temporal models T in seconds.

    Raises
    ------
    InputError
        When a sigma is not positive, a part not within 0 to 1, or a model unknown.
    """

    bias_px: float = 10.0
    drift_px: float = 1.0
    common_to_pass: float = 0.5
    correlation: str = "none"
    correlation_parameter: float = 0.0

    def __post_init__(self) -> None:
        for name in ("bias_px", "drift_px"):
            value = getattr(self, name)
            if not (np.isfinite(value) and value > 0.0):
                raise InputError(f"priors: {name} is {value}; expected a positive number of pixels")
        if not 0.0 <= self.common_to_pass <= 1.0:
            raise InputError(f"priors: common_to_pass is {self.common_to_pass}; expected a part of the variance, 0 to 1")
        if self.correlation not in CORRELATION_MODELS:
            raise InputError(f"priors: correlation is {self.correlation!r}; expected one of {', '.join(CORRELATION_MODELS)}")
        if self.correlation == "fixed" and not 0.0 <= self.correlation_parameter < 1.0:
            raise InputError(f"priors: fixed correlation is {self.correlation_parameter}; expected 0 to below 1")
        if self.correlation in ("exponential", "gaussian") and not self.correlation_parameter > 0.0:
            raise InputError(f"priors: time constant is {self.correlation_parameter}; expected a positive number of seconds")

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> APriori:
        """The model of an entry of ``priors.json``; an unknown key is refused."""
        known = {f: values[f] for f in cls.__dataclass_fields__ if f in values}
        unknown = sorted(set(values) - set(known))
        if unknown:
            raise InputError(f"priors: unknown key {unknown[0]!r}; expected some of {', '.join(cls.__dataclass_fields__)}")
        try:
            model = str(known.pop("correlation", "none"))
            return cls(correlation=model, **{name: float(value) for name, value in known.items()})
        except (TypeError, ValueError):
            raise InputError(f"priors: {dict(values)!r} holds something that is not a number") from None

    def to_mapping(self) -> dict[str, Any]:
        """The entry of ``priors.json``."""
        return {f: getattr(self, f) for f in self.__dataclass_fields__}

    def correlations(self, seconds: Array) -> Array:
        """Correlation matrix (n, n) of the own parts of n images taken at these times (n,), in seconds; NaN where unknown."""
        n = len(seconds)
        if self.correlation == "none":
            return np.eye(n)
        if self.correlation == "fixed":
            return np.full((n, n), self.correlation_parameter) + (1.0 - self.correlation_parameter) * np.eye(n)
        if not np.isfinite(seconds).all():
            raise InputError("priors: a temporal correlation needs the time of every image of the block (column 'acquired')")
        dt = np.abs(seconds[:, None] - seconds[None, :]) / self.correlation_parameter
        return np.asarray(np.exp(-dt) if self.correlation == "exponential" else np.exp(-(dt**2)))


@dataclass(frozen=True)
class ImagePrior:
    """What the a priori factor needs to know of one image; ``a_priori`` is None when it has nothing to adjust."""

    block_id: str
    pass_id: str
    seconds: float
    a_priori: APriori | None
    bias: tuple[int, ...]
    released: bool = False


def correlation_factor(correlation: Array) -> Array:
    """``F`` with ``F F' = correlation``, by eigenvalues, negative ones (round-off) clipped to zero."""
    values, vectors = np.linalg.eigh(correlation)
    return np.asarray(vectors * np.sqrt(np.clip(values, 0.0, None)))


def prior_factor(images: Sequence[ImagePrior], parameters: int) -> sp.csr_array:
    """Factor ``K`` (m p, q) of the a priori covariance of m images with p parameters each, image-major.

    Columns are whitened vectors: one for every image and parameter (its block's own parts), and two for every pass. An image without
    a priori model has none: its parameters are zero. Images may be any subset of a network: ``K K'`` is then the marginal of the whole
    prior.
    """
    m, p = len(images), parameters
    rows: list[NDArray[np.int64]] = []
    columns: list[NDArray[np.int64]] = []
    values: list[Array] = []
    blocks: dict[str, list[int]] = {}
    passes: dict[str, list[int]] = {}
    for i, image in enumerate(images):
        if image.a_priori is not None:
            blocks.setdefault(image.block_id, []).append(i)
            passes.setdefault(image.pass_id, []).append(i)

    column_of = np.cumsum([0, *(image.a_priori is not None for image in images)]) * p
    for members in blocks.values():
        model = images[members[0]].a_priori
        assert model is not None
        own = np.full((len(members), p), model.drift_px)
        released = np.array([images[i].released for i in members])
        for k, i in enumerate(members):
            own[k, list(images[i].bias)] = model.bias_px * (1.0 if released[k] else np.sqrt(1.0 - model.common_to_pass))
        own[released] *= RELEASE_FACTOR
        # what a bad camera does says nothing of its neighbours: correlated at a hundred times the sigma, it would pin them
        correlation = model.correlations(np.array([images[i].seconds for i in members]))
        alone = released[:, None] | released[None, :]
        np.fill_diagonal(alone, False)
        factor = correlation_factor(np.where(alone, 0.0, correlation))
        at = np.array(members)
        for c in range(p):
            row, column = np.meshgrid(at * p + c, column_of[at] + c, indexing="ij")
            rows.append(row.ravel())
            columns.append(column.ravel())
            values.append((factor * own[:, c : c + 1]).ravel())

    for k, members in enumerate(passes.values()):
        for i in members:
            model = images[i].a_priori
            assert model is not None
            shared = model.bias_px * np.sqrt(model.common_to_pass)
            rows.append(i * p + np.array(images[i].bias))
            columns.append(column_of[-1] + 2 * k + np.arange(2))
            values.append(np.full(2, shared))

    shape = (m * p, int(column_of[-1]) + 2 * len(passes))
    if not blocks:
        return sp.csr_array(shape)
    factor_k = sp.coo_array((np.concatenate(values), (np.concatenate(rows), np.concatenate(columns))), shape=shape).tocsr()
    factor_k.eliminate_zeros()
    return factor_k
