"""One game of StarCraft II with SMAC around it, as a program that is told what to do through pipes.

It runs by its path in an interpreter of the user's choice, which has SMAC and numpy but not race:
the game's protocol needs libraries that are too old for others. So this file imports nothing of
ours and keeps to what Python 3.8 understands. What both ends say is JSON and arrays in numpy's own
format, of which nothing is unpickled (`send`, `receive`).
"""

from __future__ import annotations

import contextlib
import importlib
import importlib.metadata
import importlib.util
import io
import json
import os
import platform
import queue
import random
import signal
import struct
import subprocess
import sys
import threading
import time
from pathlib import Path
from typing import IO, Any

import numpy as np

_MARK = b"race"
_LONGEST = 2**24  # bytes of a message's JSON
_CLOSING_SECONDS = 4.0
_SIZES = ("n_agents", "n_actions", "obs_shape", "state_shape", "episode_limit")
_FACTS = ("battle_won", "episode_limit")


class RefusedError(Exception):
    """Something that the user can mend. ``kind`` is its name, ``facts`` go into a message."""

    def __init__(self, kind: str, **facts: Any) -> None:
        super().__init__(kind)
        self.kind, self.facts = kind, facts


def send(stream: IO[bytes], message: dict[str, Any], arrays: dict[str, Any] | None = None) -> None:
    """Writes a message: a mark, the length of its JSON, the JSON, then the arrays as .npy files."""
    blobs = {}
    for name, array in (arrays or {}).items():
        blob = io.BytesIO()
        np.lib.format.write_array(blob, np.ascontiguousarray(array), allow_pickle=False)
        blobs[name] = blob.getvalue()
    sizes = {name: len(blob) for name, blob in blobs.items()}
    text = json.dumps({"message": message, "arrays": sizes}).encode()
    stream.write(b"".join([_MARK, struct.pack(">I", len(text)), text, *blobs.values()]))
    stream.flush()


def receive(stream: IO[bytes]) -> tuple[dict[str, Any], dict[str, Any]]:
    """Reads what `send` wrote.

    Raises:
        EOFError: if the stream is at its end.
        ValueError: if it is something else.
    """
    head = _exactly(stream, len(_MARK) + 4)
    (size,) = struct.unpack(">I", head[len(_MARK) :])
    if not head.startswith(_MARK) or size > _LONGEST:
        raise ValueError("this is no message")
    told = json.loads(_exactly(stream, size))
    arrays = {}
    for name, length in told["arrays"].items():
        blob = io.BytesIO(_exactly(stream, length))
        arrays[name] = np.lib.format.read_array(blob, allow_pickle=False)
    return told["message"], arrays


def _exactly(stream: IO[bytes], size: int) -> bytes:
    found = stream.read(size)
    if len(found) < size:
        raise EOFError
    return found


def installed(package: str) -> dict[str, Any]:
    """What is installed for ``smac`` or ``smacv2``: versions, the game, and where it is.

    Raises:
        RefusedError: if anything is missing.
    """
    spec = importlib.util.find_spec(package)
    places = list(spec.submodule_search_locations or []) if spec is not None else []
    if not places:
        raise RefusedError("missing")
    place = next((p for p in places if Path(p, "env", "starcraft2").is_dir()), None)
    if place is None:
        raise RefusedError("namesake", place=places[0])
    try:
        importlib.import_module(f"{package}.env")
        flags = importlib.import_module("absl.flags")
        configs = importlib.import_module("pysc2.run_configs")
    except Exception as error:
        raise RefusedError("import", text=_text(error)) from error
    if not flags.FLAGS.is_parsed():
        flags.FLAGS(["race"])  # PySC2 asks them
    return {
        "code": _origin(package, place),
        "libraries": {
            "python": platform.python_version(),
            **{name: _version(name) for name in ("pysc2", "s2clientprotocol", "protobuf")},
            "numpy": np.__version__,
        },
        "place": place,
        **_game(configs, None),
    }


def _game(configs: Any, version: str | None) -> dict[str, Any]:
    """Which game PySC2 would start."""
    base = str(Path(os.environ.get("SC2PATH", "~/StarCraftII")).expanduser())
    if not Path(base, "Versions").is_dir():
        raise RefusedError("no game", base=base, told="SC2PATH" in os.environ)
    try:
        config = configs.get(version=version)
        build = int(config.version.build_version)
    except Exception as error:
        raise RefusedError("game", base=base, text=_text(error)) from error
    binary = Path(base, "Versions", f"Base{build:05d}", "SC2_x64")
    if platform.system() == "Linux" and not os.access(binary, os.X_OK):
        raise RefusedError("game", base=base, text=f"{binary} is not there, or no program")
    names = [v.game_version for v in configs.lib.VERSIONS.values() if v.build_version == build]
    named = version or " or ".join(names) or config.version.game_version
    return {"game": f"{named} (build {build})", "base": base}


def _origin(package: str, place: str) -> str:
    """Version and commit of SMAC, as far as they can be known."""
    version, commit, root = "of unknown version", "", Path(place).parent
    if (root / ".git").exists():  # no folder above it: that may be another project's
        git = ["git", "-C", str(root), "rev-parse", "HEAD"]
        with contextlib.suppress(OSError):
            done = subprocess.run(git, stdout=subprocess.PIPE, check=False)
            commit = done.stdout.decode().strip()
    with contextlib.suppress(importlib.metadata.PackageNotFoundError, ValueError):
        found = importlib.metadata.distribution(package)
        told = json.loads(found.read_text("direct_url.json") or "{}")
        here = Path(str(found.locate_file(package))).resolve() == Path(place).resolve()
        if here or told.get("dir_info", {}).get("editable"):  # else it is that of a namesake
            version = found.version
            commit = commit or told.get("vcs_info", {}).get("commit_id", "")
    return f"{version}, commit {commit}" if commit else version


def _version(distribution: str) -> str:
    try:
        return importlib.metadata.version(distribution)
    except importlib.metadata.PackageNotFoundError:
        return "unknown"


def _scenario(usual: dict[str, Any], race: str, place: str) -> tuple[dict[str, Any], str]:
    """The settings of SMACv2's scenarios of a race, and where they are from.

    They are the package's own where its examples are installed, which pip leaves out.
    """
    path = Path(place, "examples", "configs", f"sc2_gen_{race}.yaml")
    if not path.exists() or importlib.util.find_spec("yaml") is None:
        return usual, "race's copy of the package's settings"
    settings = importlib.import_module("yaml").safe_load(path.read_text("utf-8"))["env_args"]
    counts = {name: usual["capability_config"][name] for name in ("n_units", "n_enemies")}
    teams = {**settings["capability_config"], **counts}
    return {**settings, "capability_config": teams}, f"the package's {path.name}"


class Battle:
    """SMAC's environment of one map or scenario."""

    def __init__(
        self, package: str, name: str, kwargs: dict[str, Any], usual: dict[str, Any] | None
    ) -> None:
        """Launches no game yet.

        Args:
            package: ``smac`` or ``smacv2``.
            name: of a map or scenario.
            kwargs: arguments of SMAC's environment, on top of the usual ones.
            usual: the usual ones of a scenario, if the package does not bring them along.
        """
        self.found = installed(package)
        self._arguments = {"map_name": name, **kwargs}
        module = f"{package}.env"
        self._class, origin = "StarCraft2Env", ""
        if usual is not None:
            usual, origin = _scenario(usual, name.partition("_")[0], self.found["place"])
            self._arguments = {**usual, **kwargs}
            module, self._class = f"{module}.starcraft2.wrapper", "StarCraftCapabilityEnvWrapper"
        else:
            registry = importlib.import_module(f"{module}.starcraft2.maps.smac_maps")
            maps = list(registry.get_smac_map_registry())
            if name not in maps:
                raise RefusedError("unknown", known=maps)
        self._module = importlib.import_module(module)
        try:
            self._env = self._made(None)
            info = self._env.get_env_info()
            self._sizes = {name: int(info[name]) for name in _SIZES}
        except Exception as error:
            raise RefusedError("arguments", text=_text(error)) from error
        version = self._arguments.get("game_version")
        configs = importlib.import_module("pysc2.run_configs")
        self.found = {**self.found, **_game(configs, version), "scenario": origin}
        played = importlib.import_module("pysc2.maps").get(self._arguments["map_name"])
        path = Path(self.found["base"], "Maps", played.path)
        if not path.exists():
            raise RefusedError("map file", path=str(path))
        self._launched = False

    def open(self) -> dict[str, Any]:
        """Sizes, versions and names."""
        names = {}
        for what in ("state", "obs"):
            told = getattr(self._env, f"get_{what}_feature_names", None)
            names[what] = list(map(str, told())) if callable(told) else []
        return {**self.found, "info": self._sizes, "names": names}

    def reset(self, seed: int) -> dict[str, Any]:
        """Begins an episode; the first one launches the game with the seed."""
        if not self._launched:
            self._env, self._launched = self._made(seed), True
        # SMACv2 draws teams and places here, not in the game.
        random.seed(seed)
        np.random.seed(seed)  # noqa: NPY002 - it is the one that SMAC uses
        generators = np.random.SeedSequence(seed)
        drawn = getattr(self._env, "env_key_to_distribution_map", {})
        for name in sorted(drawn):
            _reseed(drawn[name], generators)
        self._env.reset()
        return self._seen()

    def step(self, actions: list[int]) -> tuple[dict[str, Any], dict[str, Any]]:
        """A step: reward, whether the episode is over, facts; and what is seen then."""
        reward, over, facts = self._env.step(actions)
        plain = {name: bool(value) for name, value in facts.items() if name in _FACTS}
        return {"reward": float(reward), "over": bool(over), "facts": plain}, self._seen()

    def render(self) -> dict[str, Any]:
        """A picture of the battle."""
        os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        return {"picture": np.asarray(self._env.render(mode="rgb_array"), np.uint8)}

    def close(self) -> None:
        """Ends the game."""
        self._env.close()

    def _made(self, seed: int | None) -> Any:
        # A copy, because SMACv2 writes into it.
        arguments = json.loads(json.dumps(self._arguments))
        if seed is not None:
            arguments.setdefault("seed", seed)
        env = getattr(self._module, self._class)(**arguments)
        inner = getattr(env, "env", env)
        # SMAC would start another game by itself and end the episode as if it had been lost.
        inner.full_restart = _broke_down
        return env

    def _seen(self) -> dict[str, Any]:
        env = self._env
        return {
            "obs": np.asarray(env.get_obs(), np.float32),
            "state": np.asarray(env.get_state(), np.float32),
            "avail_actions": np.asarray(env.get_avail_actions(), np.int8),
        }


def _broke_down() -> None:
    error = sys.exc_info()[1]
    raise RefusedError("died", text=_text(error) if error else "")


def _reseed(distribution: Any, generators: Any) -> None:
    """Gives a distribution of SMACv2, and those that it is made of, generators of a seed."""
    for name, value in sorted(vars(distribution).items()):
        if name == "rng":
            distribution.rng = np.random.default_rng(generators.spawn(1)[0])
        elif hasattr(value, "generate"):
            _reseed(value, generators)


def _text(error: BaseException) -> str:
    said = " ".join(str(error).split())[:500]
    return f"{type(error).__name__}: {said}" if said else type(error).__name__


def _answer(battle: Battle | None, message: dict[str, Any]) -> tuple[Any, dict[str, Any], Any]:
    """What a request gives: JSON, arrays, and the battle from then on."""
    what = message["do"]
    if what == "look":
        return {"found": installed(message["package"])}, {}, battle
    if what == "open":
        battle = Battle(*(message[name] for name in ("package", "name", "kwargs", "usual")))
        return battle.open(), {}, battle
    assert battle is not None
    if what == "reset":
        return {}, battle.reset(int(message["seed"])), battle
    if what == "step":
        told, seen = battle.step(message["actions"])
        return told, seen, battle
    return {}, battle.render(), battle


def main() -> None:
    """Answers until told to close, or nobody is there any more."""
    given, told = os.fdopen(os.dup(0), "rb"), os.fdopen(os.dup(1), "wb")
    # The game writes and reads there as it likes.
    os.dup2(os.open(os.devnull, os.O_RDONLY), 0)
    os.dup2(2, 1)
    here = Path(__file__).parent.resolve()
    sys.path[:] = [folder for folder in sys.path if Path(folder).resolve() != here]
    requests: queue.Queue[dict[str, Any] | None] = queue.Queue()
    threading.Thread(target=_listen, args=(given, requests), daemon=True).start()
    battle: Battle | None = None
    try:
        while True:
            message = requests.get()
            if message is None:
                return
            try:
                answer, arrays, battle = _answer(battle, message)
                send(told, {"done": answer}, arrays)
            except RefusedError as error:
                send(told, {"refused": error.kind, "facts": error.facts})
            except BrokenPipeError:
                return
            except Exception as error:
                send(told, {"refused": "failed", "facts": {"text": _text(error)}})
    finally:
        try:
            if battle is not None:
                battle.close()
        finally:
            _end()


def _listen(given: IO[bytes], requests: Any) -> None:
    """Hands requests on; when whoever asks is gone, no game outlives it for long."""
    while True:
        try:
            message, _ = receive(given)
        except (EOFError, ValueError, OSError):
            break
        requests.put(message)
    requests.put(None)
    time.sleep(_CLOSING_SECONDS)
    _end()


def _end() -> None:
    """Ends this process, and with it a game that SMAC did not end."""
    if os.getpgrp() == os.getpid():  # the group is that of this process and its game
        os.killpg(0, signal.SIGKILL)
    os._exit(1)


if __name__ == "__main__":
    main()
