"""Sensor models: image coordinates of ground points, with partials."""

from collections.abc import Iterable

from submin.errors import InputError
from submin.sensors.base import Drift, DriftingSensor, Ground, Parameter, Projection, Sensor
from submin.sensors.frame import FrameSensor
from submin.sensors.height import HeightSensor
from submin.sensors.pushbroom import PushbroomSensor
from submin.sensors.rpc import RpcSensor
from submin.sensors.survey import SHIFTS, SurveySensor

SENSORS: dict[str, Sensor] = {
    sensor.name: sensor
    for sensor in (RpcSensor(), PushbroomSensor(), FrameSensor(), SurveySensor(), SurveySensor("survey set", SHIFTS), HeightSensor())
}
SURVEYS = ("survey", "survey set")
"""Sensors of control: of a point by itself, and of one of a set of correlated points."""


def width_of(sensors: Iterable[str]) -> int:
    """Adjustable parameters of the one of these sensors that has most; images of the others are padded with parameters of zero partial."""
    return max((len(sensor_named(name).parameters) for name in sensors), default=0)


def sensor_named(name: str) -> Sensor:
    """The sensor model of that name; raises `InputError` for an unknown one."""
    try:
        return SENSORS[name]
    except KeyError:
        raise InputError(f"sensor is {name!r}; expected one of {', '.join(sorted(SENSORS))}") from None


__all__ = ["SENSORS", "SURVEYS", "Drift", "DriftingSensor", "Ground", "Parameter", "Projection", "Sensor", "sensor_named", "width_of"]
