"""The files of `deploy/`: valid for Kubernetes, KubeRay and systemd, and as closed as the threat model says."""

from __future__ import annotations

import copy
import shutil
import subprocess
from pathlib import Path

import click
import jsonschema
import pytest
import yaml

from catstream.cli.fleet_nodes import head, node
from catstream.fleet import keeper, stream
from catstream.registry import REGISTRY
from catstream.wire.channels import CHANNELS

ROOT = Path(__file__).parents[2]
MANIFEST = list(yaml.safe_load_all((ROOT / "deploy" / "kuberay.yaml").read_text()))
SCHEMA = yaml.safe_load((Path(__file__).parent / "kubernetes.schema.yaml").read_text())
UNITS = sorted((ROOT / "deploy").glob("*.service"))
COMMANDS = {"head": head, "node": node}
EVERY_UNIT = pytest.mark.parametrize("unit", UNITS, ids=lambda path: path.stem)


def of_kind(kind):
    return {one["metadata"]["name"]: one["spec"] for one in MANIFEST if one["kind"] == kind}


CLUSTER = of_kind("RayCluster")["catstream"]
PODS = {
    "head": CLUSTER["headGroupSpec"]["template"]["spec"],
    "node": CLUSTER["workerGroupSpecs"][0]["template"]["spec"],
}
EVERY_POD = pytest.mark.parametrize("name", PODS)


def parsed(words, **variables):
    """What `catstream fleet head` or `node` reads from its command line."""
    program, group, name, *options = words
    assert (Path(program).name, group) == ("catstream", "fleet")
    for variable, value in variables.items():
        options = [word.replace(variable, value) for word in options]
    assert not [word for word in options if "$" in word]
    with click.Context(COMMANDS[name]) as context:
        COMMANDS[name].parse_args(context, options)
        return context.params


def values(unit):
    """The lines NAME=VALUE of a unit, the last of each name."""
    lines = [line for line in unit.read_text().splitlines() if "=" in line and not line.startswith("#")]
    return dict(line.split("=", 1) for line in lines)


@pytest.mark.parametrize("document", MANIFEST, ids=lambda one: f"{one['kind']}-{one['metadata']['name']}")
def test_each_object_of_the_manifest_is_valid(document):
    jsonschema.Draft202012Validator(SCHEMA).validate(document)


@pytest.mark.parametrize(
    "change",
    [
        lambda spec: spec.update(autentication="token"),
        lambda spec: spec.pop("authOptions"),
        lambda spec: spec["headGroupSpec"]["template"]["spec"].pop("securityContext"),
        lambda spec: spec["headGroupSpec"]["template"]["spec"]["containers"][0].pop("readinessProbe"),
        lambda spec: spec["workerGroupSpecs"][0].update(replicas="3"),
    ],
)
def test_the_schema_finds_a_mistake(change):
    document = copy.deepcopy(next(one for one in MANIFEST if one["kind"] == "RayCluster"))
    change(document["spec"])
    with pytest.raises(jsonschema.ValidationError):
        jsonschema.Draft202012Validator(SCHEMA).validate(document)


@EVERY_POD
def test_a_pod_runs_a_keeper_with_options_that_it_has(name):
    (container,) = PODS[name]["containers"]
    address = {"$(POD_IP)": "10.1.2.3", "$(CATSTREAM_FLEET_SERVICE_HOST)": "10.1.2.3", "$(POD_NAME)": "node-1"}
    options = parsed([*container["command"], *container["args"]], **address)
    assert options["listen" if name == "head" else "address"] == "10.1.2.3:6400"
    mounted = {mount["mountPath"] for mount in container["volumeMounts"]}
    assert str(options["folder"] if name == "head" else options["token_file"].parent) in mounted
    if name == "node":
        assert options["cores"] < float(container["resources"]["requests"]["cpu"])


@EVERY_POD
def test_a_keeper_gets_the_token_of_the_secret_as_a_file_that_only_it_can_read(name):
    (copied,) = PODS[name]["initContainers"]
    assert copied["command"] == ["install", "-m", "600", "/secret/auth_token", "/var/lib/catstream/token"]
    volumes = {volume["name"]: volume for volume in PODS[name]["volumes"]}
    assert volumes["token"]["secret"]["secretName"] == "catstream"
    assert "auth_token=" not in str(PODS[name])


def test_the_state_of_the_head_is_on_the_volume_that_the_manifest_claims():
    (claim,) = of_kind("PersistentVolumeClaim")
    volumes = {volume["name"]: volume for volume in PODS["head"]["volumes"]}
    assert volumes["state"]["persistentVolumeClaim"]["claimName"] == claim


def test_the_service_leads_to_the_head():
    service = of_kind("Service")["catstream-fleet"]
    assert service["selector"] == {"ray.io/cluster": "catstream", "ray.io/node-type": "head"}
    open_ports = {port["containerPort"] for port in PODS["head"]["containers"][0]["ports"]}
    assert {port["port"] for port in service["ports"]} == open_ports
    assert CLUSTER["headGroupSpec"]["rayStartParams"]["port"] == "6400"


def test_only_pods_of_the_cluster_reach_the_ports_of_ray():
    policies = of_kind("NetworkPolicy")
    everyone = {"matchLabels": {"ray.io/cluster": "catstream"}}
    assert policies["catstream"]["podSelector"] == everyone
    assert policies["catstream"]["ingress"] == [{"from": [{"podSelector": everyone}]}]
    ray = {6400, *range(6401, 6401 + keeper.PORTS)}
    for name in policies.keys() - {"catstream"}:
        for rule in policies[name]["ingress"]:
            for port in rule["ports"]:
                assert not ray & set(range(port["port"], port.get("endPort", port["port"]) + 1))


def test_clients_reach_the_registry_and_the_ports_of_streams():
    policies = of_kind("NetworkPolicy")
    (registry,) = policies["catstream-registry"]["ingress"][0]["ports"]
    assert registry["port"] == keeper.REGISTRY_PORT == parsed_registry_port()
    (streams,) = policies["catstream-streams"]["ingress"][0]["ports"]
    last = max(stream._PORTS) + max(channel.port + len(channel.senders) for channel in CHANNELS.values())
    assert streams["port"] == min(stream._PORTS)
    assert streams["endPort"] >= last
    assert REGISTRY.role == "watch"


def parsed_registry_port():
    (container,) = PODS["head"]["containers"]
    return parsed([*container["command"], *container["args"]], **{"$(POD_IP)": "10.1.2.3"})["registry"]


@EVERY_UNIT
def test_a_unit_runs_a_keeper_with_options_that_it_has(unit):
    variables = {"${LISTEN}": "10.0.0.1:6400", "${HEAD}": "10.0.0.1:6400", "${NODE}": "north-1", "${CORES}": "7"}
    parsed(values(unit)["ExecStart"].split(), **variables)


@EVERY_UNIT
def test_a_unit_restarts_its_keeper_and_keeps_strangers_out(unit):
    found = values(unit)
    expected = {
        "Restart": "always",
        "StartLimitIntervalSec": "0",
        "IPAddressDeny": "any",
        "IPAddressAllow": "localhost 10.0.0.0/8 172.16.0.0/12 192.168.0.0/16",
        "NoNewPrivileges": "yes",
        "ProtectSystem": "strict",
        "UMask": "0077",
        "User": "catstream",
        "CapabilityBoundingSet": "",
    }
    assert {name: found.get(name) for name in expected} == expected


def test_the_units_differ_only_in_what_they_run():
    lines = [unit.read_text().partition("[Unit]")[2].splitlines() for unit in UNITS]
    (first, second) = lines
    differing = {a.partition("=")[0] for a, b in zip(first, second, strict=True) if a != b}
    assert differing <= {"Description", "EnvironmentFile", "Environment", "ExecStart", "RuntimeDirectory"} | {
        line for line in first if line.startswith("#")
    }


@EVERY_UNIT
def test_systemd_accepts_a_unit(unit, tmp_path):
    if shutil.which("systemd-analyze") is None:
        pytest.skip("systemd-analyze is not installed: the unit was not verified by systemd")
    there = tmp_path / unit.name
    there.write_text(unit.read_text().replace("/opt/catstream/bin/catstream", shutil.which("true") or "/bin/true"))
    verified = subprocess.run(["systemd-analyze", "verify", there], capture_output=True, text=True, check=False)
    assert (verified.returncode, verified.stderr) == (0, "")
    exposed = ["systemd-analyze", "security", "--offline=yes", "--threshold=25", there]
    assert subprocess.run(exposed, capture_output=True, check=False).returncode == 0, "exposed more than 2.5 of 10"
