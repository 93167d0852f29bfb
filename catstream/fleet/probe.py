"""Asks the head of a Ray cluster for its nodes: `python -P -m catstream.fleet.probe HOST:PORT`.

Ray retries for a minute with a wrong token, and writes to the terminal meanwhile; this process asks once. It prints one
JSON object: `{"nodes": [...]}`, `{"refused": true}` if the token is wrong, `{"open": true}` if the cluster answers
without one, or `{"error": "..."}`. The variables of `catstream.fleet.cluster.environment` have to be set.
"""

from __future__ import annotations

import json
import os
import secrets
import sys
from importlib import import_module
from typing import Any

__all__ = ["main"]

_SECONDS = 8.0


def ask(address: str) -> dict[str, Any]:
    """Return the answer of the head at an address as this module prints it."""
    raylet: Any = import_module("ray._raylet")
    refused = import_module("ray.exceptions").AuthenticationError
    os.environ["RAY_AUTH_TOKEN"] = secrets.token_hex(32)  # it comes before RAY_AUTH_TOKEN_PATH
    try:
        raylet.GcsClient(address=address)
        return {"open": True}
    except refused:
        del os.environ["RAY_AUTH_TOKEN"]
    raylet.AuthenticationTokenLoader.instance().reset_cache()
    try:
        found = raylet.GcsClient(address=address).get_all_node_info(timeout=_SECONDS).values()
    except refused:
        return {"refused": True}
    return {"nodes": [_facts(info) for info in found if info.state == 0]}


def _facts(info: Any) -> dict[str, Any]:
    labels = dict(info.labels)
    name = labels.get("catstream/node") or info.node_name or info.node_id.hex()[:12]
    return {"name": name, "labels": labels, "socket": info.raylet_socket_name}


def main() -> None:
    """Print the answer of the head at the address in the arguments."""
    try:
        answer = ask(sys.argv[1])
    except Exception as error:  # whatever Ray raises is reported to the parent
        answer = {"error": f"{type(error).__name__}: {error}".partition("\n")[0]}
    print(json.dumps(answer), flush=True)
    os._exit(0)  # Ray's threads would delay the end


if __name__ == "__main__":
    main()
