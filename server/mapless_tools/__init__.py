"""Tools beside the server, each a command of `mapless-server`; the server imports none of them.

cli/            the command line
evaluate/       accuracy on benchmarks, as in the paper
bench/          accuracy and latency of a version, against targets
bench_network/  the networks' speed
load/           load, soak
ingest/         import and export; formats/ reads what other programs write
replay/         captured calls computed again
view/           the viewer in the browser
load_ray/       replicas on Ray Serve, measured on this machine
demo/           photographs of a room, and `make demo`
"""
