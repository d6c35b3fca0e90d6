"""Alembic environment: runs the migrations on the connection passed by `Database.upgrade`."""

from alembic import context

from service.store.tables import Base

engine = context.config.attributes["engine"].execution_options(sgsst_writes=True)
with engine.connect() as connection:
    context.configure(connection=connection, target_metadata=Base.metadata, render_as_batch=True)
    with context.begin_transaction():
        context.run_migrations()
