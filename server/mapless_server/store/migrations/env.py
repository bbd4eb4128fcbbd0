"""Run by alembic: executes every pending step, in the caller's transaction."""

from alembic import context

# In batch mode, a table that SQLite cannot alter is replaced.
context.configure(connection=context.config.attributes["connection"], render_as_batch=True)
context.run_migrations()
