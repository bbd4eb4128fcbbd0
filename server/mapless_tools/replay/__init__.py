"""Answers of captured calls, computed again and compared: `mapless-server replay`.

`recompute` answers a captured call on the `stand_ins` of store and choice; `comparing` lists what differs, `report`
does so for a whole folder.
"""
