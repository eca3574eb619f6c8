"""Zenoh with certificates on both sides and access control: a base, its agent, and two agents without access."""

import datetime
import ipaddress
import json
import subprocess
import sys
import time
from pathlib import Path

import pytest
from cryptography import x509
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec

from kiteline_hw.links.zenoh_link import ZenohHub
from tests.hw.processes import free_port

NAME = x509.oid.NameOID.COMMON_NAME

AGENT = """
import sys, time
from kiteline_hw.links.zenoh_link import ZenohLink
with ZenohLink(sys.argv[1], int(sys.argv[2])) as link:
    end = time.monotonic() + float(sys.argv[3])
    got = 0
    while time.monotonic() < end and not got:
        link.send(b"from " + sys.argv[2].encode())
        time.sleep(0.05)
        got += len(link.receive())
    print(got)
"""


def authority(name: str) -> tuple[ec.EllipticCurvePrivateKey, x509.Certificate]:
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NAME, name)])
    made = _builder(subject, subject, key).add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
    return key, made.sign(key, hashes.SHA256())


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePrivateKey
) -> x509.CertificateBuilder:  # fmt: skip
    now = datetime.datetime.now(datetime.UTC)
    return (
        x509.CertificateBuilder().subject_name(subject).issuer_name(issuer).public_key(key.public_key())
        .serial_number(x509.random_serial_number()).not_valid_before(now - datetime.timedelta(hours=1))
        .not_valid_after(now + datetime.timedelta(days=1))
    )  # fmt: skip


def certificate(folder: Path, name: str, ca: tuple[ec.EllipticCurvePrivateKey, x509.Certificate]) -> dict[str, str]:
    """A key and a certificate for a name, as files."""
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NAME, name)])
    names = x509.SubjectAlternativeName(
        [x509.DNSName("localhost"), x509.IPAddress(ipaddress.ip_address("127.0.0.1"))]
    )  # fmt: skip
    made = _builder(subject, ca[1].subject, key).add_extension(names, critical=False)
    made = made.add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
    usage = x509.ExtendedKeyUsage([x509.oid.ExtendedKeyUsageOID.SERVER_AUTH, x509.oid.ExtendedKeyUsageOID.CLIENT_AUTH])
    made = made.add_extension(usage, critical=False)
    files = {"key": folder / f"{name}.key", "cert": folder / f"{name}.pem"}
    files["key"].write_bytes(
        key.private_bytes(
            serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
        )
    )  # fmt: skip
    files["cert"].write_bytes(made.sign(ca[0], hashes.SHA256()).public_bytes(serialization.Encoding.PEM))
    return {k: str(v) for k, v in files.items()}


def client_config(folder: Path, name: str, files: dict[str, str], root: Path) -> str:
    path = folder / f"{name}.json5"
    tls = {
        "root_ca_certificate": str(root), "enable_mtls": True, "connect_private_key": files["key"],
        "connect_certificate": files["cert"], "verify_name_on_connect": True,
    }  # fmt: skip
    path.write_text(json.dumps({"transport": {"link": {"tls": tls}}}))
    return str(path)


def base_config(folder: Path, files: dict[str, str], root: Path) -> str:
    """The base lets whoever has a certificate of the authority in, and agent1 alone write as agent 1."""
    path = folder / "base.json5"
    tls = {
        "root_ca_certificate": str(root), "enable_mtls": True, "listen_private_key": files["key"],
        "listen_certificate": files["cert"],
    }  # fmt: skip
    listening = ["declare_subscriber", "declare_liveliness_subscriber", "liveliness_query", "query", "reply"]
    access = {
        "enabled": True,
        "default_permission": "deny",
        "rules": [
            {
                "id": "listen", "messages": listening, "flows": ["ingress", "egress"], "permission": "allow",
                "key_exprs": ["kiteline/1/default/**"],
            },
            {
                "id": "speak", "messages": ["put", "delete", "liveliness_token"], "flows": ["ingress", "egress"],
                "permission": "allow", "key_exprs": ["kiteline/1/default/1/**", "kiteline/1/default/base"],
            },
        ],
        "subjects": [{"id": "agent1", "cert_common_names": ["agent1"]}],
        "policies": [{"rules": ["listen", "speak"], "subjects": ["agent1"]}],
    }  # fmt: skip
    path.write_text(json.dumps({"transport": {"link": {"tls": tls}}, "access_control": access}))
    return str(path)


def test_access_by_certificate(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    ours, theirs = authority("kiteline test"), authority("somebody else")
    root = tmp_path / "root.pem"
    root.write_bytes(ours[1].public_bytes(serialization.Encoding.PEM))
    monkeypatch.setenv("ZENOH_CONFIG", base_config(tmp_path, certificate(tmp_path, "base", ours), root))
    endpoint = f"tls/localhost:{free_port()}"
    people = {
        "agent1": (1, ours),
        "agent2": (1, ours),  # a certificate of another agent
        "stranger": (1, theirs),  # a certificate of another authority, in the name of the first
    }

    def run(hub: ZenohHub, *names: str) -> tuple[list[bytes], list[int]]:
        """Start agents together. Returns the packets that the hub received, and how many each agent received."""
        children = []
        for name in names:
            number, ca = people[name]
            files = certificate(tmp_path, "agent1" if name == "stranger" else name, ca)
            config = client_config(tmp_path, name, files, root)
            child = subprocess.Popen(
                [sys.executable, "-c", AGENT, endpoint, str(number), "8" if name == "agent1" else "2.5"],
                env={"ZENOH_CONFIG": config, "PYTHONPATH": ":".join(sys.path), "PATH": ""},
                stdout=subprocess.PIPE, text=True,
            )  # fmt: skip
            children.append(child)
        packets: list[bytes] = []
        while any(child.poll() is None for child in children):
            for link in hub.links().values():
                packets += link.receive()
                if packets:
                    link.send(b"welcome")
            time.sleep(0.02)
        return packets, [int(child.communicate()[0]) for child in children]

    with ZenohHub(endpoint) as hub:
        assert run(hub, "agent2", "stranger") == ([], [0, 0])
        packets, (answered,) = run(hub, "agent1")
    assert packets and set(packets) == {b"from 1"}
    assert answered > 0
