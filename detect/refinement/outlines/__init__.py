"""Outlines of no kind, fitted to a candidate's rays, and contact with larger things: what competes with the kinds."""

from prim.lazy import lazy_exports

__all__, __getattr__, __dir__ = lazy_exports(
    __name__,
    {
        "contact_of": "detect.refinement.outlines.contact",
        "fit_free_outline": "detect.refinement.outlines.free_outline",
        "fit_polygons": "detect.refinement.outlines.polygons",
        "fit_templates": "detect.refinement.outlines.templates",
    },
)
