"""The world of a reconstruction: its unit of length, origin and way up, by what is known of them.

May import `reconstruct.pictures`, the server's rooms, and the layouts and fits of `ingest`. Begin with `placing.place`,
then `tags` and `squares`, `gps`, `down`; `flags` are those of commands.
"""
