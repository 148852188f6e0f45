"""Images to boxes, kinds and first guesses of parameters, on ONNX Runtime."""
