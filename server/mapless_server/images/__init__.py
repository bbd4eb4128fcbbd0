"""From the bytes of a stranger's photograph to pixels: `decode`.

Imports nothing of the other rooms but scheduling's; a photograph is refused by its header, before memory is allocated.
"""
