"""What alembic runs: every step due, in the transaction that the caller has begun and will end."""

from __future__ import annotations

from alembic import context

# As a batch, SQLite is given a table anew where it cannot alter it.
context.configure(connection=context.config.attributes["connection"], render_as_batch=True)
context.run_migrations()
