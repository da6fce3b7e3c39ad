"""A priori model of the images' adjustable parameters, as a factor: what is believed of a camera before any measurement.

The correction of a parameter is the sum of a part of the image's own and a part common to all images of its pass. Both are written by
whitened vectors ``u`` with covariance I (docs/mathematics.md, "Parameter vectors are held whitened"): ``theta = K u``, so the a priori
covariance is ``Q = K K'`` and ``Q^-1`` is never formed. Correlations between the images of a block are factored as *correlation* matrices,
of which the nearly singular ones (images seconds apart) lose nothing: a negative computed eigenvalue is clipped to zero, which only says
that two corrections are equal.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields, replace
from functools import lru_cache
from typing import Any

import numpy as np
import scipy.sparse as sp
from numpy.typing import NDArray

from submin.adjustment.joint_errors import marginal_factor
from submin.errors import InputError
from submin.sensors.base import Parameter

Array = NDArray[np.float64]

RELEASE_FACTOR = 100.0
"""Sigmas of an image whose camera was found to be bad are multiplied by this, and it is correlated with no other: its position is left to
the network (decision 004)."""

CORRELATION_MODELS = ("none", "fixed", "exponential", "gaussian")
CORRECTIONS = {
    "shift": ("bias",),
    "shift+drift": ("bias", "drift along lines"),
    "affine": ("bias", "drift along lines", "drift along samples"),
}
"""Groups of parameters of an RPC that are adjustable, by the name of the correction: along lines is along the time of a scan."""
_SIGMA_OF_GROUP = {"bias": "bias_px", "drift along lines": "drift_px", "drift along samples": "drift_px"}


@dataclass(frozen=True)
class Uncertainty:
    """What is believed of one parameter of an image.

    Parameters
    ----------
    sigma : float
        Total sigma, in the unit of the parameter; 0 holds it as it is.
    common_to_pass : float
        Part (0 to 1) of its *variance* that all images of one pass share.
    correlation, correlation_parameter : str, float
        Of the images' own parts within a block, see `APriori`.

    Raises
    ------
    InputError
        When a value is out of its range.
    """

    sigma: float
    common_to_pass: float = 0.0
    correlation: str = "none"
    correlation_parameter: float = 0.0

    def __post_init__(self) -> None:
        if not (np.isfinite(self.sigma) and self.sigma >= 0.0):
            raise InputError(f"priors: sigma is {self.sigma}; expected 0 (held as it is) or a positive number")
        if not 0.0 <= self.common_to_pass <= 1.0:
            raise InputError(f"priors: common_to_pass is {self.common_to_pass}; expected a part of the variance, 0 to 1")
        if self.correlation not in CORRELATION_MODELS:
            raise InputError(f"priors: correlation is {self.correlation!r}; expected one of {', '.join(CORRELATION_MODELS)}")
        if self.correlation == "fixed" and not 0.0 <= self.correlation_parameter < 1.0:
            raise InputError(f"priors: fixed correlation is {self.correlation_parameter}; expected 0 to below 1")
        if self.correlation in ("exponential", "gaussian") and not self.correlation_parameter > 0.0:
            raise InputError(f"priors: time constant is {self.correlation_parameter}; expected a positive number of seconds")

    def correlations(self, seconds: Array) -> Array:
        """Correlation matrix (n, n) of the own parts of n images taken at these times (n,), in seconds; NaN where unknown."""
        n = len(seconds)
        if self.correlation == "none" or n == 1:
            return np.eye(n)
        if self.correlation == "fixed":
            return np.full((n, n), self.correlation_parameter) + (1.0 - self.correlation_parameter) * np.eye(n)
        if not np.isfinite(seconds).all():
            raise InputError("priors: a temporal correlation needs the time of every image of the block (column 'acquired')")
        dt = np.abs(seconds[:, None] - seconds[None, :]) / self.correlation_parameter
        return np.asarray(np.exp(-dt) if self.correlation == "exponential" else np.exp(-(dt**2)))


@dataclass(frozen=True)
class APriori:
    """A priori sigmas of the adjustable parameters of images, and how they are shared.

    Parameters
    ----------
    bias_px : float
        Total sigma of the shift of an RPC image, in sample and in line each, pixels.
    drift_px : float
        Sigma of each drift parameter of an RPC image: the shift at the edge of the image, pixels.
    common_to_pass : float
        Part (0 to 1) of the *variance* that all images of one pass share, of the parameters that a sensor says a pass can share
        (the shift of an RPC image).
    correlation : str
        Correlation of the images' own parts within a block: ``none``, ``fixed`` (the same between any two), ``exponential``
        ``exp(-dt/T)`` or ``gaussian`` ``exp(-(dt/T)^2)`` in the time between the images.
    correlation_parameter : float
        For ``fixed`` the correlation (0 to below 1); for the temporal models T in seconds.
    correction : str
        Which parameters of an RPC image are adjustable: ``shift``, ``shift+drift`` (along lines, that is in time) or ``affine``.
    bias_m : float, optional
        Instead of ``bias_px``: total sigma of the shift in metres on the ground, along each axis; of each image by the size of its own
        pixel (`in_pixels`), so that an error common to a pass is the same on the ground in images of different pixels.
    parameters : mapping
        What differs for some parameters, by their name or group (see `submin.sensors.base.Parameter`): any of ``sigma`` (in the
        parameter's unit), ``common_to_pass``, ``correlation``, ``correlation_parameter``. A name goes before its group.

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
    correction: str = "affine"
    parameters: Mapping[str, Mapping[str, Any]] = field(default_factory=dict, hash=False)
    bias_m: float | None = None

    def __post_init__(self) -> None:
        for name, unit in (("bias_px", "pixels"), ("drift_px", "pixels"), ("bias_m", "metres")):
            value = getattr(self, name)
            if value is not None and not (np.isfinite(value) and value > 0.0):
                raise InputError(f"priors: {name} is {value}; expected a positive number of {unit}")
        if self.correction not in CORRECTIONS:
            raise InputError(f"priors: correction is {self.correction!r}; expected one of {', '.join(CORRECTIONS)}")
        Uncertainty(1.0, self.common_to_pass, self.correlation, self.correlation_parameter)
        for name, entry in self.parameters.items():
            if not isinstance(entry, Mapping):
                raise InputError(f"priors: parameters: {name!r} is {entry!r}; expected an object with some of {', '.join(_UNCERTAINTY)}")
            unknown = sorted(set(entry) - set(_UNCERTAINTY))
            if unknown:
                raise InputError(f"priors: parameters: {name!r}: unknown key {unknown[0]!r}; expected some of {', '.join(_UNCERTAINTY)}")
            _uncertainty(name, {"sigma": 1.0, **self._common, **entry})

    @property
    def _common(self) -> dict[str, Any]:
        return {"correlation": self.correlation, "correlation_parameter": self.correlation_parameter}

    @classmethod
    def from_mapping(cls, values: Mapping[str, Any]) -> APriori:
        """The model of an entry of ``priors.json``; an unknown key is refused."""
        names = [f.name for f in fields(cls)]
        unknown = sorted(set(values) - set(names))
        if unknown:
            raise InputError(f"priors: unknown key {unknown[0]!r}; expected some of {', '.join(names)}")
        known: dict[str, Any] = {name: str(values[name]) for name in ("correlation", "correction") if name in values}
        by_parameter = values.get("parameters", {})
        if not isinstance(by_parameter, Mapping):
            raise InputError(f"priors: parameters is {by_parameter!r}; expected an object with an entry by parameter or group")
        try:
            known |= {name: float(value) for name, value in values.items() if name not in (*known, "parameters")}
        except (TypeError, ValueError):
            raise InputError(f"priors: {dict(values)!r} holds something that is not a number") from None
        return cls(**known, parameters=by_parameter)

    def to_mapping(self) -> dict[str, Any]:
        """The entry of ``priors.json``; what is as it would be without an entry is left out of ``parameters`` and ``correction``."""
        values = {f.name: getattr(self, f.name) for f in fields(self)}
        values["parameters"] = {name: dict(entry) for name, entry in self.parameters.items()}
        for name in ("correction", "parameters", "bias_m"):
            if values[name] == getattr(_PLAIN, name):
                del values[name]
        return values

    def in_pixels(self, pixel: float) -> APriori:
        """The model of an image with pixels of this size on the ground, metres: as it is where the shift is stated in pixels.

        Three digits are more than anybody knows of a sigma; so images of one camera have one model.

        Examples
        --------
        >>> APriori(bias_m=15.0).in_pixels(2.5).bias_px
        6.0
        """
        return self if self.bias_m is None else replace(self, bias_px=float(f"{self.bias_m / pixel:.3g}"), bias_m=None)

    def of(self, parameter: Parameter) -> Uncertainty:
        """What is believed of a parameter of a sensor; a shift that is stated in metres is in metres until `in_pixels`."""
        sigma = parameter.sigma
        if parameter.group in _SIGMA_OF_GROUP:
            name = "bias_m" if parameter.group == "bias" and self.bias_m is not None else _SIGMA_OF_GROUP[parameter.group]
            sigma = getattr(self, name) if parameter.group in CORRECTIONS[self.correction] else 0.0
        stated = {"sigma": sigma, "common_to_pass": self.common_to_pass if parameter.shared else 0.0, **self._common}
        for name in (parameter.group, parameter.name):
            stated |= self.parameters.get(name, {})
        return _uncertainty(parameter.name, stated)

    def shares_errors(self, parameters: Sequence[Parameter]) -> bool:
        """True when some of the error of an image with these parameters is common to its pass."""
        return any(stated.sigma > 0.0 and stated.common_to_pass > 0.0 for stated in map(self.of, parameters))


_UNCERTAINTY = tuple(f.name for f in fields(Uncertainty))
_PLAIN = APriori()


def _uncertainty(name: str, values: Mapping[str, Any]) -> Uncertainty:
    """The uncertainty of some values, which ``name`` names in errors."""
    try:
        known: dict[str, Any] = {key: str(value) if key == "correlation" else float(value) for key, value in values.items()}
        return Uncertainty(**known)
    except (TypeError, ValueError):
        raise InputError(f"priors: parameters: {name!r} holds something that is not a number: {dict(values)!r}") from None
    except InputError as error:
        raise InputError(f"priors: parameters: {name!r}: {str(error).removeprefix('priors: ')}") from None


@dataclass(frozen=True, eq=False)
class JointRows:
    """A priori model of a view of a point with a full covariance: its rows of the factor that its set has in common.

    Attributes
    ----------
    rows : (k, q) of the set's factor C (`submin.adjustment.joint_errors`), a row for each of the view's first k parameters
    part : of the variance that a coordinate has when all others are known, what its ray has
    """

    rows: Array
    part: float


@dataclass(frozen=True)
class ImagePrior:
    """What the a priori factor needs to know of one image; ``a_priori`` is None when it has no camera to adjust.

    ``parameters`` are those of its sensor, the first ones of the image's parameters. ``joint`` is the model of a view of correlated
    control instead; views of one block are of one set.
    """

    block_id: str
    pass_id: str
    seconds: float
    a_priori: APriori | None
    parameters: tuple[Parameter, ...]
    released: bool = False
    joint: JointRows | None = field(default=None, compare=False, repr=False)

    @property
    def shares_errors(self) -> bool:
        """True when some of the image's error is common to its pass."""
        return self.a_priori is not None and self.a_priori.shares_errors(self.parameters)

    @property
    def correlated(self) -> bool:
        """True when the own error of the image is correlated with those of its block, or set."""
        if self.a_priori is None:
            return self.joint is not None
        return any(stated.sigma > 0.0 and stated.correlation != "none" for stated in (_stated(self.a_priori, p) for p in self.parameters))


def correlation_factor(correlation: Array) -> Array:
    """The symmetric root ``F`` with ``F F' = correlation``, by eigenvalues, negative ones (round-off) clipped to zero.

    The symmetric one does not depend on which eigenvectors a library returns: whitened vectors mean the same on every machine.
    """
    values, vectors = np.linalg.eigh(correlation)
    return np.asarray((vectors * np.sqrt(np.clip(values, 0.0, None))) @ vectors.T)


@dataclass(frozen=True, eq=False)
class WhitenedColumns:
    """What the columns of an a priori factor are: columns of the images' own first, then those of passes, then those of sets.

    Attributes
    ----------
    image, parameter : (k,) image and parameter that each of the first columns belongs to; in a correlated block it moves other images too
    passes : pass and name of the parameter of each of the columns that follow
    sets : block of each set of correlated control, and how many columns it has
    """

    image: NDArray[np.int64]
    parameter: NDArray[np.int64]
    passes: tuple[tuple[str, str], ...]
    sets: tuple[tuple[str, int], ...]


def prior_factor(images: Sequence[ImagePrior], parameters: int) -> sp.csr_array:
    """Factor ``K`` (m p, q) of the a priori covariance of m images with p parameters each, image-major.

    Columns are whitened vectors: one for every image and adjustable parameter (its block's own parts), image-major, and one for every pass
    and parameter that its images share; then those of each set of correlated control. An image without a priori model has none: its
    parameters are zero, as are those that its sensor does not have. Images may be any subset of a network: ``K K'`` is then the marginal
    of the whole prior.
    """
    return prior_and_columns(images, parameters)[0]


def prior_and_columns(images: Sequence[ImagePrior], parameters: int) -> tuple[sp.csr_array, WhitenedColumns]:
    """The factor of `prior_factor`, and what its columns are."""
    m, p, columns = len(images), parameters, 0
    sets: dict[str, list[int]] = {}
    own_column: dict[tuple[int, int], int] = {}
    alone: list[tuple[int, int, float]] = []
    correlated: dict[tuple[str, tuple[Parameter, ...], int], list[tuple[int, int, float]]] = {}
    shared: dict[tuple[str, str], list[tuple[int, float]]] = {}
    for i, image in enumerate(images):
        if image.joint is not None:
            sets.setdefault(image.block_id, []).append(i)
        if image.a_priori is not None:
            for c, parameter in enumerate(image.parameters):
                stated = _stated(image.a_priori, parameter)
                if not stated.sigma > 0.0:
                    continue
                own = stated.sigma * (RELEASE_FACTOR if image.released else np.sqrt(1.0 - stated.common_to_pass))
                entry = i * p + c, columns, own
                own_column[i, c], columns = columns, columns + 1
                if stated.correlation == "none":
                    alone.append(entry)
                else:
                    correlated.setdefault((image.block_id, image.parameters, c), []).append(entry)
                if stated.common_to_pass > 0.0:
                    common = stated.sigma * np.sqrt(stated.common_to_pass)
                    shared.setdefault((image.pass_id, parameter.name), []).append((i * p + c, common))

    entries = _Entries()
    entries.add_single(alone)
    for (_, parameters_of, c), of_block in correlated.items():
        rows, own_columns, own_sigmas = map(np.array, zip(*of_block, strict=True))
        members = [images[row // p] for row in rows.tolist()]
        # one model of the correlation for the block, but a shift stated in metres has each image's own size in pixels
        first = members[0]
        assert first.a_priori is not None
        stated = _stated(first.a_priori, parameters_of[c])
        seconds, released = np.array([image.seconds for image in members]), np.array([image.released for image in members])
        entries.add(rows, own_columns, _own_factor(stated, seconds, released) * own_sigmas[:, None])
    entries.add_single([(row, columns + k, sigma) for k, of_pass in enumerate(shared.values()) for row, sigma in of_pass])
    columns += len(shared)
    widths = []
    for block_id, of_set in sets.items():
        views = [(i, joint.rows) for i in of_set if (joint := images[i].joint) is not None]
        factor = marginal_factor(np.concatenate([rows for _, rows in views]))
        at = np.concatenate([i * p + np.arange(len(rows)) for i, rows in views])
        entries.add(at, columns + np.arange(factor.shape[1]), factor)
        columns += factor.shape[1]
        widths.append((block_id, factor.shape[1]))
    of_image, of_parameter = np.array(list(own_column), dtype=np.int64).reshape(-1, 2).T
    return entries.factor((m * p, columns)), WhitenedColumns(of_image, of_parameter, tuple(shared), tuple(widths))


def prior_variance(prior: sp.csr_array, parameters: int) -> Array:
    """Diagonal of ``K K'`` as (m, p)."""
    row = np.repeat(np.arange(prior.shape[0]), np.diff(prior.indptr))
    variance = np.asarray(np.bincount(row, prior.data**2, prior.shape[0]), dtype=np.float64)
    return variance.reshape(-1, parameters)


@lru_cache(maxsize=1 << 14)
def _stated(model: APriori, parameter: Parameter) -> Uncertainty:
    return model.of(parameter)


def _own_factor(stated: Uncertainty, seconds: Array, released: NDArray[np.bool_]) -> Array:
    """Factor of the correlation of a block's own parts of one parameter.

    What a bad camera does says nothing of its neighbours: correlated at a hundred times the sigma, it would pin them.
    """
    correlation = stated.correlations(seconds)
    alone = released[:, None] | released[None, :]
    np.fill_diagonal(alone, False)
    return correlation_factor(np.where(alone, 0.0, correlation))


class _Entries:
    """Dense pieces of a sparse matrix, collected."""

    def __init__(self) -> None:
        self._rows: list[NDArray[np.int64]] = []
        self._columns: list[NDArray[np.int64]] = []
        self._values: list[Array] = []

    def add(self, rows: NDArray[np.int64], columns: NDArray[np.int64], values: Array) -> None:
        """``values`` (n, k) at n rows and k columns."""
        self._rows.append(np.repeat(rows, len(columns)))
        self._columns.append(np.tile(columns, len(rows)))
        self._values.append(values.ravel())

    def add_single(self, entries: Sequence[tuple[int, int, float]]) -> None:
        """Rows, columns and values one by one."""
        if entries:
            rows, columns, values = zip(*entries, strict=True)
            self._rows.append(np.array(rows))
            self._columns.append(np.array(columns))
            self._values.append(np.array(values))

    def factor(self, shape: tuple[int, int]) -> sp.csr_array:
        """The whole matrix, without stored zeros."""
        if not self._rows:
            return sp.csr_array(shape)
        rows, columns, values = (np.concatenate(parts) for parts in (self._rows, self._columns, self._values))
        order = np.lexsort((columns, rows))
        order = order[values[order] != 0.0]
        starts = np.cumsum(np.bincount(rows + 1, weights=values != 0.0, minlength=shape[0] + 1)).astype(np.int32)
        return sp.csr_array((values[order], columns[order].astype(np.int32), starts), shape=shape)
