"""API process whose compromised readers execute a scene's content as code."""

import sys
from pathlib import Path

from api.http.server import main
from service.inspection import inspector as inspector

inspector.COMMAND = (sys.executable, str(Path(__file__).with_name("compromised.py")))
main()
