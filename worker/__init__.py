"""One job on several ranks: process group, Ray workers, recovery."""
