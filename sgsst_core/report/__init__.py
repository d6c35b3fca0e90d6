"""Reports of finished jobs: JSON document, HTML page, charts and contact sheet."""
