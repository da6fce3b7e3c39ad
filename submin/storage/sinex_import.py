"""Geodetic solutions as control with full covariance: SINEX files, and GNSS files of one cluster of positions."""

from __future__ import annotations

from collections import Counter
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import numpy as np
from numpy.typing import NDArray

from submin.adjustment.constraint_removal import information_of, without_constraint
from submin.errors import InputError, NumericalError
from submin.formats.sinex import Matrix, Parameter, SinexFile, read_sinex
from submin.geodesy import WGS84, geocentric_to_geodetic, local_axes, rotate_covariance
from submin.storage.catalogue_schema import PointTable
from submin.storage.gnss_import import read_gnss
from submin.storage.point_table import write_point_table

Array = NDArray[np.float64]

COORDINATES = ("STAX", "STAY", "STAZ")
SIGMAS_AGREE = 1e-3
"""Relative difference of the standard deviations of an estimate and of its matrix that printing explains (four digits or more)."""
_CONSTRAINTS = {"0": "fixed or tight", "1": "significant"}


@dataclass(frozen=True)
class SolutionImport:
    """What an import of a solution has written.

    Attributes
    ----------
    file : table of control
    points : number of them
    frame, epoch : of the coordinates, as far as the file or the command states them
    constraint : what became of the a priori constraint: ``removed``, ``kept`` or ``none``
    constraint_share : greatest part of the information in any direction that was the constraint's; 0 where none was removed
    sigma_min, sigma_max : least and greatest standard deviation of a coordinate, m
    notes : one line each
    """

    file: Path
    points: int
    frame: str
    epoch: str
    constraint: str
    constraint_share: float
    sigma_min: float
    sigma_max: float
    notes: tuple[str, ...]


@dataclass(frozen=True, eq=False)
class _Solution:
    """Positions (n, 3) with their joint covariance (3n, 3n), geocentric, m and m2."""

    ids: Sequence[str]
    geocentric: Array
    covariance: Array
    frame: str
    epoch: str
    constraint: str
    share: float
    notes: tuple[str, ...]


def import_solution(
    file: str | Path,
    out: str | Path,
    *,
    keep_constraints: bool = False,
    frame: str | None = None,
    epoch: str | None = None,
    prefix: str = "",
) -> SolutionImport:
    """Write the positions of a geodetic solution as a table of control with their joint covariance.

    Parameters
    ----------
    file
        SINEX, or a GNSS file (``.msr``, ``.xml``) of one cluster of positions; perhaps gzipped.
    out
        Parquet file to write: the layout of ``control``, longitude and latitude on WGS84.
    keep_constraints
        Take the estimate as it stands, its a priori constraint in it. Else the constraint is taken out, and a file whose constraint
        cannot be taken out is refused.
    frame, epoch
        What is expected: a file that states another one is refused. An epoch may be the beginning of its ISO 8601 text.
    prefix
        Goes before the name of each station.

    Raises
    ------
    InputError
        When the file cannot be used: line, value, what was expected. Nothing is written then.
    """
    path = Path(file)
    is_gnss = any(suffix.lower() in (".msr", ".xml") for suffix in path.suffixes[-2:])
    found = _of_gnss(path) if is_gnss else _of_sinex(path, read_sinex(path), keep_constraints)
    if frame is not None and found.frame and frame != found.frame:
        raise InputError(f"{path}: the coordinates are of frame {found.frame}; expected {frame}: nothing is transformed")
    if epoch is not None and found.epoch and not found.epoch.startswith(epoch):
        raise InputError(f"{path}: the coordinates are of epoch {found.epoch}; expected {epoch}: nothing is transformed")
    stated_frame, stated_epoch = found.frame or frame or "", found.epoch or epoch or ""
    n = len(found.ids)
    geodetic = geocentric_to_geodetic(found.geocentric, WGS84)
    own = found.covariance.reshape(n, 3, n, 3)[np.arange(n), :, np.arange(n), :]
    enu = rotate_covariance(own, local_axes(geodetic))
    points = PointTable(np.array([prefix + name for name in found.ids]), geodetic, enu, np.zeros(n, dtype=np.str_), found.covariance)
    write_point_table(out, points, {"frame": stated_frame, "epoch": stated_epoch, "source": path.name, "constraint": found.constraint})
    sigma = np.sqrt(np.diagonal(found.covariance))
    return SolutionImport(
        Path(out), n, stated_frame, stated_epoch, found.constraint, found.share, float(sigma.min()), float(sigma.max()), found.notes
    )


def _of_gnss(path: Path) -> _Solution:
    measurements = read_gnss(path).measurements
    if [m.type for m in measurements] != ["Y"]:
        counts = ", ".join(f"{count} {kind}" for kind, count in sorted(Counter(m.type for m in measurements).items()))
        raise InputError(f"{path}: holds measurements {counts}; expected one cluster of positions (Y): 'submin import gnss' reads others")
    (m,) = measurements
    ids = m.from_ids.tolist()
    twice = [name for name, count in Counter(ids).items() if count > 1]
    if twice:
        raise InputError(f"{path}: line {m.line}: station {twice[0]!r} comes twice in the cluster; expected it once")
    return _Solution(ids, m.values, m.covariance, m.frame, m.epoch, "none", 0.0, ())


def _of_sinex(path: Path, file: SinexFile, keep_constraints: bool) -> _Solution:
    notes: list[str] = []
    ids, rows, epoch = _stations(path, file, notes)
    values = np.array([parameter.value for parameter in file.estimate])
    covariance = _estimate_covariance(path, file)
    scale = _checked_sigmas(path, file, covariance, notes)
    constraint, share = "none", 0.0
    stated = _CONSTRAINTS.get(file.constraint)
    if file.variance_factor is not None:
        notes.append(
            f"the file states a variance factor of {file.variance_factor:.6g}; the covariance is taken as it stands, not multiplied"
        )
    if file.a_priori_matrix is not None:
        if keep_constraints:
            constraint = "kept"
            notes.append("the a priori constraint is kept: control of this file is as accurate as it says only if the constraint is")
        else:
            information = _information(path, file, file.a_priori_matrix)
            held = np.diagonal(information) > 0.0
            a_priori = np.where(held, file.a_priori_values, values)
            try:
                freed = without_constraint(values, covariance, a_priori, information, file.matrix.digits)
            except NumericalError as error:
                raise InputError(
                    f"{path}: line {file.a_priori_matrix.line}: {error}. Take it as it stands by --keep-constraints, "
                    "which holds the datum by the constraint"
                ) from None
            moved = float(np.abs(freed.estimate - values)[rows].max())
            growth = float(np.sqrt(np.diagonal(freed.covariance) / np.diagonal(covariance))[rows].max())
            values, covariance, constraint, share = freed.estimate, freed.covariance, "removed", freed.share
            notes.append(
                f"the a priori constraint is removed: it was {share:.2g} of the information in one direction at most; "
                f"coordinates move by {moved:.2g} m at most, standard deviations grow by a factor of {growth:.7g} at most"
            )
            if stated and share < 0.5:
                notes.append(
                    f"the header calls the constraints {stated} (code {file.constraint}), but those that it states are loose: "
                    "what else holds the datum (orbits, for instance) is not in the file and stays in the estimate"
                )
    elif stated or any(parameter.sigma > 0.0 for parameter in file.a_priori):
        said = f"the header calls the constraints {stated} (code {file.constraint})" if stated else "the file states a priori sigmas"
        if not keep_constraints:
            raise InputError(
                f"{path}: line 1: {said}, and there is no SOLUTION/MATRIX_APRIORI to take them out; expected the constraint, or none. "
                "Take the estimate as it stands by --keep-constraints"
            )
        constraint = "kept"
        notes.append(f"{said}; they are kept: control of this file is as accurate as it says only if the constraint is")
    geocentric = values[rows].reshape(-1, 3)
    return _Solution(ids, geocentric, scale * covariance[np.ix_(rows, rows)], "", epoch, constraint, share, tuple(notes))


def _stations(path: Path, file: SinexFile, notes: list[str]) -> tuple[list[str], NDArray[np.int64], str]:
    """Names of the stations, rows of their coordinates (3n,), and their epoch."""
    rows: dict[tuple[str, str, str], dict[str, int]] = {}
    for row, parameter in enumerate(file.estimate):
        if parameter.type not in COORDINATES:
            continue
        place = f"{path}: line {parameter.line}: {parameter.type} of station {parameter.site!r}"
        if parameter.unit != "m":
            raise InputError(f"{place} has unit {parameter.unit!r}; expected 'm'")
        if file.sites is not None and (parameter.site, parameter.point) not in file.sites:
            raise InputError(f"{place}, point {parameter.point!r}: unknown; expected a station of SITE/ID")
        found = rows.setdefault((parameter.site, parameter.point, parameter.solution), {})
        if parameter.type in found:
            raise InputError(f"{place} comes at a second epoch; expected one epoch: nothing is transformed")
        found[parameter.type] = row
    if not rows:
        raise InputError(f"{path}: has no station coordinates; expected parameters {', '.join(COORDINATES)}")
    for (site, _, _), found in rows.items():
        missing = [name for name in COORDINATES if name not in found]
        if missing:
            line = file.estimate[next(iter(found.values()))].line
            raise InputError(f"{path}: line {line}: {missing[0]} of station {site!r} is missing; expected all three coordinates")
    order = np.array([found[name] for found in rows.values() for name in COORDINATES])
    epoch = _one_epoch(path, [file.estimate[row] for row in order])
    several = {site for site, count in Counter(site for site, _, _ in rows).items() if count > 1}
    if several:
        notes.append(f"stations with several points or solutions are named STATION/POINT/SOLUTION: {', '.join(sorted(several))}")
    left_out = Counter(parameter.type for parameter in file.estimate if parameter.type not in COORDINATES)
    if left_out:
        counts = ", ".join(f"{count} {name}" for name, count in sorted(left_out.items()))
        notes.append(f"parameters other than coordinates are left out, as unknown as the file has them: {counts}")
    return [site if site not in several else f"{site}/{point}/{solution}" for site, point, solution in rows], order, epoch


def _one_epoch(path: Path, coordinates: Sequence[Parameter]) -> str:
    first = coordinates[0]
    for other in coordinates:
        if other.epoch != first.epoch:
            raise InputError(
                f"{path}: line {other.line}: {other.type} of station {other.site!r} is at epoch {other.epoch or 'none'}, others are at "
                f"{first.epoch or 'none'}; expected one epoch: nothing is transformed"
            )
    return first.epoch


def _estimate_covariance(path: Path, file: SinexFile) -> Array:
    try:
        return _covariance(file.matrix, [parameter.sigma for parameter in file.estimate])
    except NumericalError as error:
        raise InputError(
            f"{path}: line {file.matrix.line}: SOLUTION/MATRIX_ESTIMATE {error}; expected the covariance of {len(file.estimate)} parameters"
        ) from None


def _information(path: Path, file: SinexFile, matrix: Matrix) -> Array:
    """Information matrix (n, n) of the constraint; zeros for the parameters without one."""
    n = len(file.estimate)
    loose = ~matrix.present & (matrix.values != 0.0).any(axis=1)
    if loose.any():
        parameter = file.estimate[int(np.argmax(loose))]
        raise InputError(
            f"{path}: line {matrix.line}: SOLUTION/MATRIX_APRIORI has no diagonal element of {parameter.type} of {parameter.site!r}; "
            "expected one where there are others of it"
        )
    sigmas = {parameter.key: parameter.sigma for parameter in file.a_priori}
    if matrix.kind == "INFO":
        information = matrix.values
    else:
        held = np.flatnonzero(matrix.present)
        part = np.ix_(held, held)
        constrained = Matrix(matrix.line, matrix.kind, matrix.values[part], matrix.present[held], matrix.digits)
        information = np.zeros((n, n))
        try:
            of_held = information_of(_covariance(constrained, [sigmas.get(file.estimate[i].key, 0.0) for i in held]))
        except NumericalError as error:
            raise InputError(
                f"{path}: line {matrix.line}: SOLUTION/MATRIX_APRIORI {error}; expected the covariance of {len(held)} parameters"
            ) from None
        information[part] = of_held
    return information


def _covariance(matrix: Matrix, sigmas: Sequence[float]) -> Array:
    """Covariance of a matrix of any kind; positive definite, else `NumericalError`."""
    if matrix.kind == "INFO":
        return information_of(matrix.values)
    covariance = matrix.values
    if matrix.kind == "CORR":
        diagonal = np.diagonal(matrix.values)
        # Its diagonal has the standard deviations; files with ones there have them with the estimates only.
        sigma = np.array(sigmas) if (diagonal == 1.0).all() else diagonal
        covariance = matrix.values * np.outer(sigma, sigma)
        np.fill_diagonal(covariance, sigma**2)
    try:
        np.linalg.cholesky(covariance)
    except np.linalg.LinAlgError:
        raise NumericalError("is not positive definite") from None
    return covariance


def _checked_sigmas(path: Path, file: SinexFile, covariance: Array, notes: list[str]) -> float:
    """Factor of the covariance by which its standard deviations are not below those that the estimate states; they must differ by one."""
    stated = np.array([parameter.sigma for parameter in file.estimate])
    given = stated > 0.0
    if not given.any():
        return 1.0
    ratio = stated[given] / np.sqrt(np.diagonal(covariance))[given]
    middle = float(np.median(ratio))
    far = np.abs(ratio / middle - 1.0) > SIGMAS_AGREE
    if far.any():
        k = int(np.flatnonzero(given)[np.argmax(far)])
        parameter = file.estimate[k]
        raise InputError(
            f"{path}: line {parameter.line}: {parameter.type} of {parameter.site!r} has a standard deviation of {parameter.sigma:.6g}, "
            f"in the matrix {np.sqrt(covariance[k, k]):.6g}; expected the same: the matrix is not that of these estimates"
        )
    if abs(middle - 1.0) <= SIGMAS_AGREE:
        return 1.0
    chosen = max(middle, 1.0)
    notes.append(
        f"standard deviations of the estimates are {middle:.6g} times those of the matrix; the greater are taken: "
        + (f"the covariance is multiplied by {chosen**2:.6g}" if chosen > 1.0 else "those of the matrix")
    )
    return chosen**2


__all__ = ["SolutionImport", "import_solution"]
