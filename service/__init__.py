"""Jobs of users: the store, files, inspection and scheduling. Modules here are shared by several of these packages."""
