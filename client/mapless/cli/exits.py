"""What the command ends with."""

EXIT_FAILED, EXIT_USAGE, EXIT_REJECTED = 1, 2, 3
