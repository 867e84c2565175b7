"""Sensors: measurements with rate, delay, noise and mounting, each a plugin that ``sim.add`` adds."""

from typing import TYPE_CHECKING

from crazysim.names import lazy_getattr

if TYPE_CHECKING:
    from crazysim.lab.plugins.radar import Radar
    from crazysim.plugins.sensors.barometer import Barometer
    from crazysim.plugins.sensors.beacons import UWB, Lighthouse
    from crazysim.plugins.sensors.camera import Camera
    from crazysim.plugins.sensors.depth_errors import Distortion, StereoNoise
    from crazysim.plugins.sensors.errors import Constant, GaussMarkov, Link, Rounded, Turned, White
    from crazysim.plugins.sensors.flow_deck import OpticalFlow, TimeOfFlight
    from crazysim.plugins.sensors.gps import GPS
    from crazysim.plugins.sensors.image_sensor import ImageData, ImageSensor
    from crazysim.plugins.sensors.imu import IMU
    from crazysim.plugins.sensors.lidar import Lidar
    from crazysim.plugins.sensors.magnetometer import Magnetometer
    from crazysim.plugins.sensors.motion_capture import MotionCapture
    from crazysim.plugins.sensors.onboard import BatteryVoltage, MultiRanger, RotorSpeeds
    from crazysim.plugins.sensors.range_finder import RangeFinder
    from crazysim.plugins.sensors.sensor import Samples, Sensor
    from crazysim.plugins.sensors.triad import Triad
    from crazysim.scene.appearance import RandomColors
    from crazysim.scene.depth import RandomPose

__all__ = [
    "GPS",
    "IMU",
    "UWB",
    "Barometer",
    "BatteryVoltage",
    "Camera",
    "Constant",
    "Distortion",
    "GaussMarkov",
    "ImageData",
    "ImageSensor",
    "Lidar",
    "Lighthouse",
    "Link",
    "Magnetometer",
    "MotionCapture",
    "MultiRanger",
    "OpticalFlow",
    "Radar",
    "RandomColors",
    "RandomPose",
    "RangeFinder",
    "RotorSpeeds",
    "Rounded",
    "Samples",
    "Sensor",
    "StereoNoise",
    "TimeOfFlight",
    "Triad",
    "Turned",
    "White",
]

__getattr__ = lazy_getattr(__name__)
