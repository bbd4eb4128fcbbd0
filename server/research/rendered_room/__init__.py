"""A furnished room made of nothing but random numbers, photographed with exact poses and depths.

The demo's photographs (`server/mapless_tools/demo/room`) are those of seed 0. Begin with `__main__`.
"""
