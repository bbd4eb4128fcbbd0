"""What a city would take: a small simulation, from figures that were measured or counted, of a fleet that is not there.

`python -m mapless_tools.planning FOLDER` draws the curves of deploy/city/README.md and prints their figures; under a
minute, the same every time. `figures` says where each number comes from, `city` who asks where, `caching`
what stays in memory, `fleet` how calls find devices and wait for them, `queueing` the closed forms beside it.
"""
