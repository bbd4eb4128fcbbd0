"""Computes the answers of captured calls again and compares them (`replay`); localizes recordings (`replay-bag`).

`recompute` answers a captured call on its recorded inputs, `comparing` lists the differences, and `report` does so
for a whole folder. It may import the services, the engine and the method, whose results it reproduces. `bags` localizes
recordings through a server.
"""
