"""The command line `mapless-server`: one small module for each group of commands.

`app` has them all. The commands of the server (serve, store, token, weights) run without the packages of the extra
`tools`; the flags of the other commands stand in their own rooms of `mapless_tools`. No module imports at its top what
only a running command needs, so that --help answers at once.
"""
