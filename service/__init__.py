"""Job service: settings, durable store, inputs and artifacts on disk, and the dispatcher that runs the jobs."""
