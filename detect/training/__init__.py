"""Data sets, the networks in torch, their training and export."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "DatasetOptions": "detect.training.dataset",
        "make_dataset": "detect.training.dataset",
        "train_all": "detect.training.recipe",
        "train_weights": "detect.training.recipe",
    },
)
