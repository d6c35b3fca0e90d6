"""Files of jobs: inputs stored by digest (`blobs`), and results in the file store (`objects`)."""
