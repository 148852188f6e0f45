"""From a log to maps, scores, a report and a recording for the viewer."""
