"""The manifest of `deploy/`: as closed as the threat model says, with the ports that the streams use."""

from pathlib import Path

import yaml

from catstream.client.registry import REGISTRY, REGISTRY_PORT
from catstream.wire.discovery import PORTS

ROOT = Path(__file__).parents[2]
MANIFEST = list(yaml.safe_load_all((ROOT / "deploy" / "kuberay.yaml").read_text()))
GCS_PORT = 6379  # of Ray's head


def of_kind(kind):
    return {one["metadata"]["name"]: one["spec"] for one in MANIFEST if one["kind"] == kind}


CLUSTER = of_kind("RayCluster")["catstream"]
GROUPS = {"head": CLUSTER["headGroupSpec"], "node": CLUSTER["workerGroupSpecs"][0]}


def test_a_node_leaves_a_core_to_ray_and_the_head_runs_no_stream():
    (container,) = GROUPS["node"]["template"]["spec"]["containers"]
    assert float(GROUPS["node"]["rayStartParams"]["num-cpus"]) == float(container["resources"]["requests"]["cpu"]) - 1
    assert GROUPS["head"]["rayStartParams"]["num-cpus"] == "0"


def test_the_cluster_asks_for_the_token_and_the_manifest_does_not_contain_it():
    assert CLUSTER["authOptions"] == {"mode": "token"}
    assert "auth_token" not in str(MANIFEST)


def test_the_service_leads_to_the_registry_on_the_head():
    service = of_kind("Service")["catstream-fleet"]
    assert service["selector"] == {"ray.io/cluster": "catstream", "ray.io/node-type": "head"}
    assert [port["port"] for port in service["ports"]] == [REGISTRY_PORT]


def test_only_pods_of_the_cluster_reach_the_ports_of_ray():
    policies = of_kind("NetworkPolicy")
    everyone = {"matchLabels": {"ray.io/cluster": "catstream"}}
    assert policies["catstream"]["podSelector"] == everyone
    assert policies["catstream"]["ingress"] == [{"from": [{"podSelector": everyone}]}]
    for name in policies.keys() - {"catstream"}:
        for rule in policies[name]["ingress"]:
            for port in rule["ports"]:
                assert GCS_PORT not in range(port["port"], port.get("endPort", port["port"]) + 1)


def test_clients_reach_the_registry_and_the_ports_of_streams():
    policies = of_kind("NetworkPolicy")
    (registry,) = policies["catstream-registry"]["ingress"][0]["ports"]
    assert registry["port"] == REGISTRY_PORT
    (streams,) = policies["catstream-streams"]["ingress"][0]["ports"]
    assert (streams["port"], streams["endPort"] >= PORTS[-1] + PORTS.step) == (PORTS[0], True)
    assert REGISTRY.role == "watch"
