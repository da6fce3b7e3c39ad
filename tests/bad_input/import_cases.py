"""Cases of imports of images, and of GNSS files, geodetic solutions and observations."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
from gnss_files import MEASUREMENTS, dna_lines, simulated
from isis_files import binary, points

from bad_input.disks import limited, read_only
from bad_input.world import World, case, simply
from submin.storage.gnss_import import import_gnss
from submin.storage.rpc_import import import_rpc
from submin.storage.sinex_import import import_solution

# --- imports ----------------------------------------------------------------------------------------------------------------------------


def imported(name: str, change: Callable[[World], Any]) -> None:
    """Enter a case in which the inputs of an import are changed."""

    def words(w: World) -> list[Any]:
        given = w.importing()
        change(w)
        return given

    case(name)(words)


simply("imported RPC without a list of coefficients", lambda w: w.rpc(lambda c: c.pop("SAMP_DEN_COEFF")))
simply("imported RPC with 19 coefficients", lambda w: w.rpc(lambda c: c["LINE_NUM_COEFF"].pop()))
simply("imported RPC with swapped axes", lambda w: w.rpc(lambda c: c.update(LAT_OFF=c["LONG_OFF"], LONG_OFF=c["LAT_OFF"])))
simply("imported RPC with a scale of zero", lambda w: w.rpc(lambda c: c.update(LONG_SCALE=0.0)))
imported("missing RPC", lambda w: (w.folder / "rpc" / f"{w.columns('images')['image_id'][0]}.json").unlink())
imported("RPC file that is none", lambda w: w.write(f"rpc/{w.columns('images')['image_id'][0]}.json", "mine"))
imported("missing column of an import", lambda w: w.replace("tracks.csv", "col", "column"))
imported("unknown image in a track", lambda w: w.replace("tracks.csv", "T000", "T999"))
imported(
    "ray twice in the tracks", lambda w: w.write("tracks.csv", (t := (w.folder / "tracks.csv").read_text()) + t.splitlines()[1] + "\n")
)
imported("no such file of tracks", lambda w: (w.folder / "tracks.csv").unlink())
imported("folder that holds something already", lambda w: shutil.copytree(w.catalogue, w.new))
imported("file in place of a new catalogue", lambda w: w.write("new", "mine"))


simply("ISIS network that is none", lambda w: w.isis("Object = ControlNetwork", "Object = Network"))
simply("no such ISIS network", lambda w: [*w.isis()[:2], w.folder / "nowhere.net", *w.isis()[3:]])
simply("ISIS network cut short", lambda w: w.isis("  End_Object\n\nEnd_Object\nEnd", ""))
simply("ISIS network that is not PVL in a line", lambda w: w.isis("PointType = Free", "PointType ="))
simply("ISIS network of an old version", lambda w: w.isis("Version = 5", "Version = 1"))
simply("control point of an ISIS network without covariance", lambda w: w.isis("AprioriCovarianceMatrix", "AprioriMatrix"))
simply("control point of an ISIS network without error", lambda w: w.isis("PointType = Constrained", "PointType = Fixed"))
simply("unknown image in an ISIS network", lambda w: w.isis("APOLLO15/METRIC/1971-07-31T14:01", "APOLLO16/METRIC/1972-04-21T14:01"))
simply(
    "scale of ISIS images that is not whole", lambda w: w.isd(focal2pixel_samples=[0.0, -140.0, 0.0], focal2pixel_lines=[0.0, 0.0, 140.0])
)
simply("ISD of a camera that is no frame camera", lambda w: w.isd(name_model="USGS_ASTRO_LINE_SCANNER_SENSOR_MODEL"))
simply("ISD of an unknown lens", lambda w: w.isd(name_sensor="WAC", optical_distortion={"radial": {"coefficients": [0.0, 1e-5, 0.0]}}))
simply("ISD without a position", lambda w: w.isd(instrument_position={}))


@case("binary ISIS network of an old version")
def _(w: World) -> list[Any]:
    words = w.isis()
    w.write("isis/network.pvl", binary(points(), version="2"))
    return words


@case("missing ISD")
def _(w: World) -> list[Any]:
    words = w.isis()
    (w.folder / "isis" / "image1.isd").unlink()
    return words


@case("point of an ISIS network twice in an image")
def _(w: World) -> list[Any]:
    return w.isis("APOLLO15/METRIC/1971-07-31T14:01", "APOLLO15/METRIC/1971-07-31T14:00")


@case("imported coordinate that is not a number")
def _(w: World) -> list[Any]:
    words = w.importing()
    lines = (w.folder / "tracks.csv").read_text().splitlines()
    track, image, _, row = lines[5].split(",")
    w.write("tracks.csv", "\n".join([*lines[:5], f"{track},{image},nan,{row}", *lines[6:]]))
    return words


@case("catalogue made on a full disk")
def _(w: World) -> list[Any]:
    words = w.importing()
    import_rpc(words[3], words[5], words[7], w.folder / "roomy")  # what is compiled is kept on disk: that it has room for
    shutil.rmtree(w.folder / "roomy")
    w.around = lambda: limited(1000)
    return words


@case("catalogue made in a folder that is read only")
def _(w: World) -> list[Any]:
    (w.folder / "closed").mkdir()
    w.around = lambda: read_only(w.folder / "closed")
    return ["simulate", "region", "--scale", 0.02, "--out", w.folder / "closed" / "catalogue"]


# --- GNSS files, solutions, observations ------------------------------------------------------------------------------------------------

simply("GNSS file of another format", lambda w: ["import", "gnss", w.write("survey.txt", "G A B"), "--out", w.new])
simply("no such GNSS file", lambda w: ["import", "gnss", w.folder / "survey.msr", "--out", w.new])
simply("GNSS file cut short", lambda w: w.gnss(lines=dna_lines()[:5]))
simply("GNSS measurement of another type", lambda w: w.gnss("G A ", "S A "))
simply("GNSS positions that are not XYZ", lambda w: w.gnss("XYZ", "LLH"))
simply("GNSS scale by direction", lambda w: w.gnss("10.00      1.00", "10.00      1.50"))
simply("GNSS covariance with too few numbers", lambda w: w.gnss(lines=[line[:102] for line in dna_lines()]))
simply("GNSS positions of another epoch", lambda w: [*w.gnss(), "--epoch", "2021-01-01"])
simply("GNSS file whose measurements are all left out", lambda w: w.gnss(lines=dna_lines((MEASUREMENTS[1],))))


@case("GNSS covariance that is none")
def _(w: World) -> list[Any]:
    flat = simulated("G", (("A", "B"),), 1)
    flat.covariance[1] = flat.covariance[:, 1] = flat.covariance[0]
    return w.gnss(lines=dna_lines((flat,)))


def replacing_values(w: World, value: float, rows: int = 3) -> list[Any]:
    lines = [f"0,G,A,B,{axis},{value if value else v:.4f},{v:.4f}" for axis, v in zip("XYZ", MEASUREMENTS[0].values[0], strict=True)]
    table = w.write("values.csv", "\n".join(["cluster,type,from,to,component,file,new", *lines[:rows], ""]))
    return [*w.gnss(lines=dna_lines(MEASUREMENTS[:1])), "--values", table]


simply("values that are of another measurement", lambda w: replacing_values(w, 1.0))
simply("values that leave one out", lambda w: replacing_values(w, 0.0, rows=2))
simply("SINEX file cut short", lambda w: w.sinex("-SOLUTION/MATRIX_ESTIMATE L COVA\n%ENDSNX\n", ""))
simply("file that is not SINEX", lambda w: w.sinex("%=SNX", "%=BIA"))


@case("SINEX file without a matrix")
def _(w: World) -> list[Any]:
    words = w.sinex()
    for _ in ("begin", "end"):
        w.replace("solution.snx", "SOLUTION/MATRIX_ESTIMATE", "SOLUTION/MATRIX_OF_OURS")
    return words


simply("SINEX matrix that is no covariance", lambda w: w.sinex(" 5.00000000000000E-07", " 5.00000000000000E-01"))
simply("SINEX line with a word too many", lambda w: w.sinex(" 5.00000000000000E-07", " 5.0E-07 5.0E-07 5.0E-07 5.0E-07"))
simply("SINEX coordinates of an unknown station", lambda w: w.sinex(" S001  A 5", " S009  A 5"))
simply("SINEX coordinates at two epochs", lambda w: w.sinex("STAX   S001  A    1 17:298", "STAX   S001  A    1 16:298"))
simply("SINEX solution with a constraint that is not in the file", lambda w: w.sinex(code="0"))
simply("SINEX solution that its constraint alone holds", lambda w: w.sinex(a_priori=(np.zeros(6), 1e-6 * (np.eye(6) + 0.5))))
simply("SINEX solution of another epoch", lambda w: [*w.sinex(), "--epoch", "2020"])
simply("GNSS file as control with baselines in it", lambda w: ["import", "sinex", w.gnss()[2], "--out", w.folder / "control.parquet"])


@case("control made where something is")
def _(w: World) -> list[Any]:
    w.write("control.parquet", "mine")
    return w.sinex()


simply("control made as CSV", lambda w: [*w.sinex()[:4], w.folder / "control.csv"])
simply("observation of another kind", lambda w: w.observed(kind=["angle"]))
simply("position with an end", lambda w: w.observed(to=["B"]))
simply("baseline without an end", lambda w: w.observed(kind=["baseline"]))
simply("position in degrees", lambda w: w.observed(x=[100.0], y=[35.0], z=[900.0]))
simply("observation that is not a number", lambda w: w.observed(x=[float("nan")]))
simply("observation whose covariance is short", lambda w: w.observed(covariance_row=[[1.0] * 3]))
simply("observation without an error of its own", lambda w: w.observed(covariance_row=[[1.0] * 9]))
simply("cluster with the id of a block of images", lambda w: w.observed(cluster=[w.block()]))
simply("baseline into a factored network", lambda w: w.observed(kind=["baseline"], to=["B"]))


def measured_alone(w: World) -> Path:
    """A catalogue of GNSS measurements alone."""
    import_gnss(w.gnss()[2], w.new)
    return w.new


simply("tiles fitted to a catalogue without images", lambda w: ["create", w.folder / "tiled", "--fit", measured_alone(w)])
simply(
    "another frame than that of the fitted catalogue", lambda w: ["create", w.folder / "tiled", "--fit", w.catalogue, "--frame", "ITRF2014"]
)
simply("plan of a catalogue without images", lambda w: ["plan", measured_alone(w), w.network])
simply("plan of a run into a dense network", lambda w: ["plan", w.catalogue, w.dense()])


@case("control of another frame than the network's")
def _(w: World) -> list[Any]:
    import_solution(w.sinex()[2], w.folder / "control.parquet", frame="ITRF2014")
    return ["control", "add", w.network, w.folder / "control.parquet"]
