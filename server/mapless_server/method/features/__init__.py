"""Features: keypoints with descriptors, their matches in two photographs, and tracks through several.

Begin with `views`, the data. `extractors` find features; `matching` says how descriptors of each kind are compared,
which `matching` and `lightglue` do; `tracks` joins matches to observations of one point.
"""
