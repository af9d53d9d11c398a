def get_smac_map_registry() -> dict[str, dict[str, int]]:
    return {
        "2s3z": {"n_agents": 2, "n_enemies": 3, "limit": 4},
        "3s5z": {"n_agents": 3, "n_enemies": 5, "limit": 4},
        "8m": {"n_agents": 8, "n_enemies": 8, "limit": 4},
    }
