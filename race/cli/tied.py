"""``python -m race.cli.tied PARENT COMMAND...``: becomes a command that ends with its parent.

A machine of a cluster that is lost takes the processes down that stand for it, and what they have
started must not go on writing to a run that another machine takes over.
"""

import ctypes
import os
import signal
import sys
from collections.abc import Sequence

_SET_PARENT_DEATH_SIGNAL = 1  # of prctl


def main(words: Sequence[str]) -> None:
    """Becomes the command, unless the parent is no longer there."""
    parent, *command = words
    if sys.platform == "linux":  # elsewhere nothing of the kind is known
        ctypes.CDLL(None).prctl(_SET_PARENT_DEATH_SIGNAL, signal.SIGKILL)
    if os.getppid() != int(parent):
        sys.exit(1)
    # Ray keeps Ctrl-C from its processes, and that would be inherited: this one is to hear of it.
    signal.signal(signal.SIGINT, signal.SIG_DFL)
    signal.pthread_sigmask(signal.SIG_UNBLOCK, {signal.SIGINT, signal.SIGTERM, signal.SIGHUP})
    os.execv(command[0], command)


if __name__ == "__main__":
    main(sys.argv[1:])
