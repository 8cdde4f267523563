"""All sensors of one vehicle."""

from __future__ import annotations

from madns_runtime.plugin.api import AgentContext
from madns_runtime.simulations.constellation.equipment import SensorNoise, Sensors
from madns_runtime.simulations.constellation.flight.api import Reading
from madns_runtime.simulations.constellation.vehicle.sensors.accelerometer import Accelerometer
from madns_runtime.simulations.constellation.vehicle.sensors.clock import Clock
from madns_runtime.simulations.constellation.vehicle.sensors.gnss import GnssReceiver
from madns_runtime.simulations.constellation.vehicle.sensors.gyro import Gyro
from madns_runtime.simulations.constellation.vehicle.sensors.magnetometer import FluxGate
from madns_runtime.simulations.constellation.vehicle.sensors.scene import Scene
from madns_runtime.simulations.constellation.vehicle.sensors.sensor import Instrument, Sensor
from madns_runtime.simulations.constellation.vehicle.sensors.star_tracker import StarTracker
from madns_runtime.simulations.constellation.vehicle.sensors.sun_sensor import SunSensor


class SensorSuite:
    """
    What a vehicle measures.

    Args:
        settings: From the scenario.
        scene: The vehicle's surroundings.
        context: Where measurements are recorded.
        chance: What the run's seed gave to the agent.

    Raises:
        MissingExtraError: The IGRF is wanted and not installed.
    """

    def __init__(
        self, settings: Sensors, scene: Scene, *, context: AgentContext, chance: bytes
    ) -> None:
        self._scene = scene
        self._sensors: list[Sensor] = []
        if settings.gnss is not None:
            gnss = GnssReceiver()
            white = gnss.white(settings.gnss)
            self._sensors.append(
                Sensor(
                    gnss,
                    settings.gnss,
                    context=context,
                    chance=chance,
                    white=white,
                    bias=gnss.bias,
                )
            )
        self._accelerometer = None if settings.accelerometer is None else Accelerometer()
        others: list[tuple[Instrument | None, SensorNoise | None]] = [
            (Gyro(), settings.gyro),
            (self._accelerometer, settings.accelerometer),
            (StarTracker(), settings.star_tracker),
            (SunSensor(), settings.sun_sensor),
            (Clock(), settings.clock),
        ]
        if settings.magnetometer is not None:
            others.append((FluxGate(settings.magnetometer, scene), settings.magnetometer))
        self._sensors += [
            Sensor(instrument, wanted, context=context, chance=chance)
            for instrument, wanted in others
            if instrument is not None and wanted is not None
        ]

    def step(self, tick: int, t_s: float, state: tuple[float, ...] | None) -> dict[str, Reading]:
        """
        Measure what is due, and return by sensor what has become known; without truth nothing is measured.

        Args:
            tick: Its number.
            t_s: Its time.
            state: Truth, or None.
        """
        if state is not None:
            scene = self._scene
            scene.move(t_s, state)
            if self._accelerometer is not None:
                self._accelerometer.feel(scene)
            for sensor in self._sensors:
                sensor.sample(scene)
        readings = {}
        for sensor in self._sensors:
            reading = sensor.read(tick, t_s)
            if reading is not None:
                readings[sensor.name] = reading
        return readings

    def summary(self) -> dict[str, dict[str, int]]:
        """Return counts by sensor."""
        return {
            sensor.name: {
                "samples": sensor.samples,
                "dropped": sensor.dropped,
                "blind": sensor.blind,
            }
            for sensor in self._sensors
        }
