"""Tools beside the server, each a command of `mapless-server`; the server imports none of them.

cli/            the command line
evaluate/       accuracy on benchmarks, as in the paper
ingest/         import and export; formats/ reads what other programs write
replay/         captured calls computed again
view/           the viewer in the browser
demo/           photographs of a room, and `make demo`
"""
