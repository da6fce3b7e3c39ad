"""Sensor models: image coordinates of ground points, with partials."""

from submin.errors import InputError
from submin.sensors.base import Ground, Projection, Sensor
from submin.sensors.rpc import RpcSensor
from submin.sensors.survey import SurveySensor

SENSORS: dict[str, Sensor] = {sensor.name: sensor for sensor in (RpcSensor(), SurveySensor())}

WIDEST = max(len(sensor.parameters) for sensor in SENSORS.values())
"""Adjustable parameters of the sensor that has most of them; images of the others are padded with parameters of zero partial."""


def sensor_named(name: str) -> Sensor:
    """The sensor model of that name; raises `InputError` for an unknown one."""
    try:
        return SENSORS[name]
    except KeyError:
        raise InputError(f"sensor is {name!r}; expected one of {', '.join(sorted(SENSORS))}") from None


__all__ = ["SENSORS", "WIDEST", "Ground", "Projection", "Sensor", "sensor_named"]
