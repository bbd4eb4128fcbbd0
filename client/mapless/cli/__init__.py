"""The command `mapless`: its arguments, its commands, and what they read and print."""
