"""A private certificate authority, and a certificate per machine or process, for mutual TLS."""

from __future__ import annotations

import contextlib
import datetime
import ipaddress
import os
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import BinaryIO, NamedTuple

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.hazmat.primitives.asymmetric.types import PrivateKeyTypes
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from swarm.config.input_files import FileKind, read_bytes
from swarm.errors import ConfigError, StoreError
from swarm.files import make_folder, replacing, write_file

CA = "ca"
THIS_MACHINE = ("localhost", "127.0.0.1")
"""Hosts in every router's certificate, for the processes beside it."""
_CA_DAYS = 3650
"""Ten years, the longest that a certificate may be asked for (`Days`): an authority that ends sooner would end what
it has signed."""
_NEW_AUTHORITY = "make an authority and all certificates again, in another folder"
_CLOCKS_DIFFER = datetime.timedelta(hours=1)


class Authority(NamedTuple):
    """A certificate authority: its certificate, and the key that never leaves its folder."""

    certificate: x509.Certificate
    key: ec.EllipticCurvePrivateKey


def authority(folder: Path) -> Authority:
    """The authority whose `ca.pem` and `ca.key` lie in the folder; made there if there is none. Raises
    StoreError where they cannot be read or written, do not belong together, or are not valid today."""
    path, secret = folder / f"{CA}.pem", folder / f"{CA}.key"
    if path.exists():
        certificate, key = check_signed(path, path, secret)
        if not isinstance(key, ec.EllipticCurvePrivateKey):
            raise StoreError(f"{secret} is no key of an elliptic curve; {_NEW_AUTHORITY}")
        return Authority(certificate, key)
    # Signs certificates and lists of revoked ones, and is for nothing else.
    usage = x509.KeyUsage(False, False, False, False, False, True, True, False, False)
    extensions = {x509.BasicConstraints(ca=True, path_length=0): True, usage: True}
    return _make(folder, CA, "swarm authority", _in_days(_CA_DAYS), extensions)


def issue(
    folder: Path, name: str, hosts: Sequence[str], days: int, *, renew: bool = False, called: str | None = None
) -> Path:
    """Writes `NAME.pem`, and `NAME.key` readable by its owner only. Returns the certificate's path.

    name    of the files, and if `called` is None what access control knows its bearer by: keeper.0, agent.all.a0
    hosts   names and addresses under which others connect to it; none for those that only connect
    called  the common name, where it is another: agent.all.a0~2 after the first was revoked
    Raises ConfigError on a host that cannot be one, StoreError where files cannot be written or are there already.
    """
    path = folder / f"{name}.pem"
    if path.exists() and not renew:
        raise StoreError(f"{path} is there already; --renew replaces it")
    reached = x509.SubjectAlternativeName([_general_name(host) for host in hosts or [name]])
    signer = authority(folder)
    # A certificate is refused once its authority has expired, so it promises no more than that.
    end = min(_in_days(days), signer.certificate.not_valid_after_utc)
    extensions = {
        x509.BasicConstraints(ca=False, path_length=None): True,
        x509.ExtendedKeyUsage([ExtendedKeyUsageOID.SERVER_AUTH, ExtendedKeyUsageOID.CLIENT_AUTH]): False,
        reached: False,
        x509.AuthorityKeyIdentifier.from_issuer_public_key(signer.key.public_key()): False,
    }
    _make(folder, name, called or name, end, extensions, signer)
    return path


def _make(
    folder: Path,
    name: str,
    called: str,
    end: datetime.datetime,
    extensions: Mapping[x509.ExtensionType, bool],
    signer: Authority | None = None,
) -> Authority:
    """Writes a certificate and its new key, and returns both.

    extensions  whether software that does not know an extension has to refuse the certificate
    signer      None: it signs itself
    """
    key = ec.generate_private_key(ec.SECP256R1())
    subject = x509.Name([x509.NameAttribute(NameOID.COMMON_NAME, called)])
    builder = (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(signer.certificate.subject if signer else subject)
        .public_key(key.public_key())
        .serial_number(x509.random_serial_number())
        .not_valid_before(_in_days(0) - _CLOCKS_DIFFER)
        .not_valid_after(end)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key.public_key()), critical=False)
    )
    for extension, is_critical in extensions.items():
        builder = builder.add_extension(extension, is_critical)
    certificate = builder.sign(signer.key if signer else key, hashes.SHA256())
    pem, plain = serialization.Encoding.PEM, serialization.NoEncryption()
    make_folder(folder)
    # The key first: a certificate never exists without its key.
    with private_file(folder / f"{name}.key") as file:
        file.write(key.private_bytes(pem, serialization.PrivateFormat.PKCS8, plain))
    write_file(folder / f"{name}.pem", certificate.public_bytes(pem))
    return Authority(certificate, key)


def _in_days(days: int) -> datetime.datetime:
    return datetime.datetime.now(datetime.UTC) + datetime.timedelta(days=days)


def _general_name(host: str) -> x509.GeneralName:
    with contextlib.suppress(ValueError):
        return x509.IPAddress(ipaddress.ip_address(host))
    try:
        return x509.DNSName(host)
    except ValueError as error:
        raise ConfigError(f"host {host!r} is neither an address nor a name in ASCII") from error


def hosts_of(path: Path) -> set[str]:
    """The names and addresses in a certificate under which its bearer is reached. Raises StoreError where it cannot
    be read."""
    try:
        names = _read(path).extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return set()
    addresses = map(str, names.get_values_for_type(x509.IPAddress))
    return {*names.get_values_for_type(x509.DNSName), *addresses}


def called_of(path: Path) -> str:
    """The common name in a certificate. Raises StoreError where it cannot be read."""
    (name,) = _read(path).subject.get_attributes_for_oid(NameOID.COMMON_NAME) or ("",)
    return name if isinstance(name, str) else str(name.value)


def ends_on(path: Path) -> datetime.date:
    """The last day of a certificate. Raises StoreError where it cannot be read."""
    return _read(path).not_valid_after_utc.date()


def may_stay(path: Path, hosts: Sequence[str], called: str) -> bool:
    """Returns True if a certificate is of its folder's authority, matches its key, has this common name and these
    hosts at least, and a third of its time or more is left."""
    try:
        certificate, _ = check_signed(path.with_name(f"{CA}.pem"), path, path.with_suffix(".key"))
    except StoreError:
        return False
    start, end = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    lasts = end - _in_days(0) >= (end - start) / 3
    wanted = {str(_general_name(host).value) for host in hosts}
    return lasts and called_of(path) == called and hosts_of(path) >= wanted


def _read(path: Path) -> x509.Certificate:
    with _pem(f"{path} is no certificate"):
        return _certificate(path)


def _certificate(path: Path) -> x509.Certificate:
    return x509.load_pem_x509_certificate(read_bytes(path, FileKind.CERTIFICATE))


@contextlib.contextmanager
def _pem(what: str) -> Iterator[None]:
    """Raises StoreError in place of what cryptography raises of a file that is not in PEM."""
    try:
        yield
    except (ValueError, TypeError) as error:
        raise StoreError(f"{what} in PEM: {error}") from error


def check_signed(ca: Path, certificate: Path, key: Path) -> tuple[x509.Certificate, PrivateKeyTypes]:
    """The certificate and the key in two files in PEM. Raises StoreError where they and `ca` do not go together:
    another authority's, another's key, or one of the certificates not valid today."""
    with _pem(f"{ca}, {certificate} and {key} are not certificates and a key"):
        authority, own = _certificate(ca), _certificate(certificate)
        secret = serialization.load_pem_private_key(read_bytes(key, FileKind.CERTIFICATE), None)
    try:
        own.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise StoreError(
            f"{certificate} is not signed by the authority in {ca}; make it again from both"
        ) from error
    if secret.public_key() != own.public_key():
        raise StoreError(f"{key} is not the key of {certificate}")
    again = "make it again with `swarm deploy certs FOLDER NAME --renew`"
    for each, path, remedy in ((authority, ca, _NEW_AUTHORITY), (own, certificate, again)):
        start, end = each.not_valid_before_utc, each.not_valid_after_utc
        if not start <= _in_days(0) <= end:
            raise StoreError(f"{path} is good from {start:%Y-%m-%d} to {end:%Y-%m-%d}, not today; {remedy}")
    return own, secret


@contextlib.contextmanager
def private_file(path: Path) -> Iterator[BinaryIO]:
    """A file to write, readable by its owner only, which then takes the place of another. Raises StoreError."""
    exclusive = os.O_WRONLY | os.O_CREAT | os.O_EXCL
    with replacing(path) as partial, open(os.open(partial, exclusive, 0o600), "wb") as file:
        yield file
