"""From a world to a log: simulated sessions of a robot with a LiDAR, GPS and compass."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "record": "recorder.api",
        "Compass": "recorder.sensors",
        "Gps": "recorder.sensors",
        "Lidar": "recorder.sensors",
        "Session": "recorder.session",
        "SessionOptions": "recorder.session",
        "record_session": "recorder.session",
        "WorldOptions": "recorder.world",
        "draw_world": "recorder.world",
    },
)
