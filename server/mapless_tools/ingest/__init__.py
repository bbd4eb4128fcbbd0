"""Import and export: a scene is filled from a folder of posed photographs, or written to one, through a server.

formats/ reads the layouts of folders, check/ compares photographs with their poses, `importing` does both and uploads.
Other tools take `formats` from here. Imports the client, the method of the server, and what all tools share. Begin with
`command`.
"""

FORMATS = {
    "cameras": "cameras",
    "colmap": "colmap",
    "7scenes": "seven_scenes",
    "12scenes": "twelve_scenes",
    "cambridge": "cambridge",
    "nerf": "nerf",
    "tum": "tum",
    "icl": "icl_nuim",
    "arkit": "arkit",
    "record3d": "record3d",
    "stray": "stray_scanner",
    "kapture": "kapture",
    "rosbag": "rosbag",
}
"""Layouts that can be read: each name, and the module of `formats` that reads it. Here, where --help has it quickly."""
