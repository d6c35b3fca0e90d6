"""One job: its options and specification, reading, preparation and execution, on one rank or several."""
