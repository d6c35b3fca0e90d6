"""Reports of finished jobs: JSON document, HTML page, charts and contact sheet; only they import matplotlib.

Functions that write a file raise an OutputError if it cannot be written.
"""

import logging

# Without a writable home folder, matplotlib uses a temporary one, and warns about it and about its search for fonts.
_matplotlib = logging.getLogger("matplotlib")
if _matplotlib.level == logging.NOTSET:  # the level of a program that uses this library has precedence
    _matplotlib.setLevel(logging.ERROR)
