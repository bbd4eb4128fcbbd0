"""A furnished room made of nothing but random numbers, photographed with exact poses and depths.

The demo's photographs (`server/mapless_tools/demo/room`) are those of seed 0; the vocabularies for retrieval were
learned from ten others. Begin with `photographs`.
"""
