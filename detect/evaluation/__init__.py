"""Evaluation of detectors: metrics, suites of experiments, tables."""
