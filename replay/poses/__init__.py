"""Where the scanner was: transforms, odometry, fusion, scan matching."""
