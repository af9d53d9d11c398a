from race.api import Rows as Rows
from race.api import Run as Run
from race.api import Team as Team
from race.api import evaluate as evaluate
from race.api import export as export
from race.api import load as load
from race.api import render as render
from race.api import train as train

__version__: str
ALGORITHM_VERSION: int
