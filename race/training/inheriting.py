"""``--init-from``: the teams of another run, made to fit, kept in the run directory, begun with.

What a run begins with is copied into its directory (``init.safetensors``), so that it stays whole
when the other run is gone.
"""

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import jax
import jax.numpy as jnp
import numpy as np

from race.algorithms import Algorithm, algorithm_of
from race.algorithms.inheriting import Inherited, begun_with, parts
from race.config.hyper import hyper_of
from race.config.settings import Config
from race.config.shape import shape_of
from race.errors import ConfigError, RunDirectoryError, command
from race.learners import learner_of
from race.method.normalisation import Observed, nothing_observed
from race.programs import start
from race.randomness import Purpose, root_key
from race.runs import directory as run_directory
from race.runs import team_files
from race.runs.directory import RunDirectory
from race.runs.trees import blank, flatten, restore
from race.training.run_state import RunState, statics
from race.types import Spec, Team


def made_to_fit(
    encoders: Mapping[str, Any],
    heads: Mapping[str, Any],
    origin: Config,
    source: Path,
    config: Config,
    spec: Spec,
) -> Inherited:
    """The teams of a run as another run can begin with them.

    Args:
        encoders: of the teams, by name.
        heads: of the teams, by name.
        origin: the settings of their run.
        source: its directory, for messages.
        config: the settings of the new run.
        spec: its task's.

    Raises:
        ConfigError: if they do not fit; says what differs.
    """
    template = _template(config, spec)
    learner = learner_of(shape_of(config))
    marl = "marl" if "marl" in heads else "champion"
    champion = "champion" if "champion" in heads else "marl"
    apart = origin.whole_teams  # then a champion has networks of its own
    if origin.discrete != config.discrete:
        raise _misfit(source, "the one has discrete actions and the other has not")
    if origin.env.normalise != config.env.normalise:
        raise _misfit(source, "one of the two normalises observations (--env.normalise)")
    encoder, head, team = encoders[marl], np.asarray(heads[marl]), None
    if config.has_marl and template.head is not None:
        head = _as_many(head, template.head, source)
    if config.whole_teams:
        own = encoders[champion]
        if not (apart and champion == "champion"):
            own = learner.of_each_agent(own)
        team = Team(own, np.asarray(heads[champion]))
    elif config.has_population:
        own = np.asarray(heads[marl if apart else champion])
        assert template.team is not None
        team = Team(None, _as_many(own, template.team.heads, source))
    fitted = Inherited(encoder, head, team)
    if not config.has_marl:
        fitted = fitted._replace(encoder=None, head=None)
    _refuse_misfit(fitted, template, source)
    return fitted


def _as_many(head: Any, wanted: Any, source: Path) -> Any:
    """One head for all agents, if that is wanted of a team whose agents have equal ones."""
    if len(wanted) >= len(head):
        return head
    if not (head == head[:1]).all():
        raise _misfit(source, "its agents have heads of their own, and here all share one")
    return head[:1]


def observed_to_fit(observed: Observed | None, source: Path, spec: Spec) -> Observed | None:
    """What the other run's teams have seen, where observations are normalised.

    Networks go on seeing things as they did; what the new run sees is added.

    Raises:
        ConfigError: if its task shows things of other sizes.
    """
    if observed is not None:
        there, here = flatten(observed), flatten(nothing_observed(spec))
        for name in there:
            if there[name].shape != here[name].shape:
                shapes = [list(side[name].shape) for side in (there, here)]
                raise _misfit(source, f"{name[1:]} is {shapes[0]} there and {shapes[1]} here")
    return observed


def store(
    path: Path, inherited: Inherited, told: Mapping[str, Any], observed: Observed | None = None
) -> None:
    """Keeps what a run begins with in its directory, which is there.

    Args:
        path: the run directory.
        inherited: what it begins with.
        told: where that comes from.
        observed: what the teams have seen, where observations are normalised.

    Raises:
        CheckpointError: if it cannot be written.
    """
    info = {**told, "run": run_directory.identity_of(path)}
    arrays = flatten(inherited)
    if observed is not None:
        arrays |= flatten({_OBSERVED: observed})
    team_files.write(RunDirectory(path).init, arrays, info)


_OBSERVED = "observed"


def inherit(path: Path, fresh: RunState, config: Config, spec: Spec) -> RunState:
    """The fresh state of a run, with what its directory says that it begins with.

    Raises:
        CheckpointError: if that is damaged.
        RunDirectoryError: if it is of another run.
    """
    arrays, info = team_files.read(RunDirectory(path).init)
    if info.get("run") != run_directory.identity_of(path):
        raise RunDirectoryError(
            f"{RunDirectory(path).init} belongs to another run than config.json beside it. Put "
            "each back where it was."
        )
    observed = None
    if config.env.normalise:
        template = {_OBSERVED: nothing_observed(spec)}
        held = {name: arrays.pop(name) for name in flatten(template) if name in arrays}
        observed = restore(template, held)[_OBSERVED]
    inherited = restore(_template(config, spec), arrays)
    begun = begun_with(fresh.algorithm, jax.tree.map(jnp.asarray, inherited))
    return fresh._replace(algorithm=begun, observed=observed)


def _template(config: Config, spec: Spec) -> Inherited:
    algorithm: Algorithm = algorithm_of(config)

    def fresh() -> Inherited:
        key = root_key(config.seed, Purpose.INIT)
        return parts(start(key, hyper=hyper_of(config), **statics(config, spec, algorithm)))

    found: Inherited = blank(jax.eval_shape(fresh))
    return found


def _refuse_misfit(fitted: Inherited, template: Inherited, source: Path) -> None:
    there, here = flatten(fitted), flatten(template)
    for name in sorted({*there, *here}):
        shapes = [list(side[name].shape) if name in side else None for side in (there, here)]
        if None in shapes:
            raise _misfit(source, f"{name[1:]} is a weight of only one of the two")
        if shapes[0] != shapes[1]:
            raise _misfit(source, f"{name[1:]} is {shapes[0]} there and {shapes[1]} here")
    # What is left is how networks are built.
    built: tuple[Any, Any] = (jax.tree.structure(fitted), jax.tree.structure(template))
    if built[0] != built[1]:
        raise _misfit(source, "the one normalises its layers and the other does not (layer-norm)")


def _misfit(source: Path, why: str) -> ConfigError:
    return ConfigError(
        f"The teams of {source} do not fit this run: {why}. Give this run that one's sizes, which "
        f"`{command('race', 'show', source)}` tells, or leave --init-from out."
    )
