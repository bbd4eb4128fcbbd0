"""`mapless-server reconstruct`: videos and photographs without poses become a folder of photographs with poses.

The mapping itself is pycolmap's; features, pairs, the unit of length, the way up and the judgement are ours. The order
of the steps is in `run.py`.
"""
