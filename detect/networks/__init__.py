"""Networks on ONNX Runtime: tiles, YOLO, parameter networks, weights."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "ParameterEstimator": "detect.networks.cnn",
        "ModelCard": "detect.networks.weights",
        "Weights": "detect.networks.weights",
        "WeightsError": "detect.networks.weights",
        "load_weight_set": "detect.networks.weights",
        "shipped_weights": "detect.networks.weights",
        "Yolo": "detect.networks.yolo",
    },
)
