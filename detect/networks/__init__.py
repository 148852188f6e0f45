"""Networks on ONNX Runtime: tiles, YOLO, parameter networks, weights."""
