"""The demo: its own server localizes photographs it has not seen before; every answer is judged and drawn.

`room/` holds its photographs, rendered by `server/research/rendered_room` with exact poses and depths. Tools that need
some photographs to run take them from here. Imports the client and `mapless_server.method`. Begin with `run`.
"""

from .photographs import Photograph, Place, depth_map_m, place_of, room, split_folder

__all__ = ["Photograph", "Place", "depth_map_m", "place_of", "room", "split_folder"]
