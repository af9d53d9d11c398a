"""A cluster of several machines, all of them this one: ``python several_nodes.py CORES...``.

The first machine has no cores. Says the address for clients; ends the machine whose number it
reads, without a warning to it, and everything when there is nothing more to read.
"""

import os
import socket
import sys

os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
# Its server for clients forks while it answers them, which gRPC's own handlers may not survive.
os.environ["GRPC_ENABLE_FORK_SUPPORT"] = "0"
os.environ["RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO"] = "0"

from ray.cluster_utils import Cluster


def free_port() -> int:
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        return int(free.getsockname()[1])


def main() -> None:
    port = free_port()
    small = {"object_store_memory": 100_000_000, "memory": 8_000_000_000}
    # The server for clients does not learn a port that is chosen later.
    served = {"ray_client_server_port": port, "runtime_env_agent_port": free_port()}
    cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **served, **small})
    nodes = [cluster.add_node(num_cpus=int(cores), **small) for cores in sys.argv[1:]]
    print(f"ray://127.0.0.1:{port}", flush=True)
    for line in sys.stdin:
        cluster.remove_node(nodes[int(line)], allow_graceful=False)
        print("gone", flush=True)
    cluster.shutdown()


if __name__ == "__main__":
    main()
