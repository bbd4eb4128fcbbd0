"""All that is stored of a photograph once the background has made it, computed at once."""

from collections.abc import Sequence
from dataclasses import replace

from mapless_server.engine.photo_views import QueryViews
from mapless_server.engine.query import Description, Photo
from mapless_server.engine.queue_engine import QueueEngine
from mapless_server.method.options import StageContext


def describe_all(engine: QueueEngine, photos: Sequence[Photo]) -> list[Description]:
    """Features of every tier, and the vectors made of them."""
    return [_described(engine, it) for it in photos]


def _described(engine: QueueEngine, photo: Photo) -> Description:
    context, views = StageContext(), QueryViews(photo, engine.options.image_limits)
    first = engine.references.describe(photo, lambda: None)
    found = {it.extractor.name: views.view(it.extractor, context) for it in engine.tiers}
    vectors = {
        it.descriptor.name: it.descriptor.describe(found[it.extractor.name]) for it in engine.references.retrievals
    }
    without_pixels = {name: replace(it, photograph=None) for name, it in found.items()}
    return replace(first, views=without_pixels, descriptors=vectors)
