"""The command `mapless`, in parts: its arguments, its commands, what they read and what they show."""
