"""Import and export: a scene is filled from a folder of posed photographs, or written to one, through a server.

formats/ reads the layouts of folders, check/ compares photographs with their poses, `importing` does one after the
other. Other tools take `formats` from here. Imports the client, the method of the server, and what all tools share.
Begin with `command`.
"""
