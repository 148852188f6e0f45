"""How good detections are: metrics, suites, tables."""
