"""A scene in the browser: its references, the points that were matched, and queries as they are answered.

    command > viewer > scenery (the references' layout)          > stage (the page) > drawing
                     > feed (WatchQueries) ----------------------^             ^
                     > failures (the layer of what fails) ---------------------

It is a client like any other: all that it shows comes from calls to a server. Only `guarded` imports
viser. Begin reading with `viewer`.
"""
