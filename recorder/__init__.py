"""From a world to a log: simulated sessions of a robot with a LiDAR, GPS and compass."""
