from race.api.commands import evaluate as evaluate
from race.api.commands import export as export
from race.api.commands import render as render
from race.api.commands import train as train
from race.api.run import Rows as Rows
from race.api.run import Run as Run
from race.api.run import load as load
from race.teams.team import Team as Team

__version__: str
ALGORITHM_VERSION: int
