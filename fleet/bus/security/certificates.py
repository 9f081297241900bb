"""Certificates: a certificate authority for one fleet, and one certificate for each participant, on disk.

ECDSA over P-256, X.509 v3 (RFC 5280). A participant's certificate says who it is in its common name, and is good for
one end of a line alone: the router's for the listening end, every other's for the connecting one. So nobody but the
router can play the router.
"""

import ipaddress
import os
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fleet.bus.security.access_control import LONGEST_COMMON_NAME, Participant
from fleet.errors import BusError

CA = "ca"
"""File name of the certificate authority, without the ending."""
LONGEST_DAYS = 3650
"""How long a certificate authority lasts; nothing that it signs outlives it."""
SKEW = timedelta(minutes=5)
"""Certificates begin this much in the past: clocks of different machines differ."""
HERE = ("localhost", "127.0.0.1", "::1")
_OWNER_ONLY, _ALL_READ = 0o600, 0o644


def new_authority(folder: Path, fleet: str, *, now: datetime | None = None) -> None:
    """Write `ca.pem` and `ca.key`, which signs for a fleet."""
    now = now or datetime.now(UTC)
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"{fleet} certificate authority"[-LONGEST_COMMON_NAME:])
    usage = _usage(key_cert_sign=True, crl_sign=True)
    built = (
        _builder(name, name, key.public_key(), now - SKEW, now + timedelta(days=LONGEST_DAYS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(usage, critical=True)
    )
    _write_pair(folder, CA, built.sign(key, hashes.SHA256()), key)


def issue(
    folder: Path, participant: Participant, *, days: int, hosts: Sequence[str] = HERE, now: datetime | None = None
) -> datetime:
    """Write `NAME.pem` and `NAME.key` for a participant, signed by the authority in the folder.

    Args:
        hosts: Names and addresses under which the router is reached, beside those of this machine; other roles have
            none.
        now: From when the days count.

    Returns:
        When the certificate ends: after `days`, or with the authority if that is sooner.

    Raises:
        BusError: the folder has no authority that can sign, or it has expired.
    """
    if not 1 <= days <= LONGEST_DAYS:
        raise BusError(f"A certificate lasts 1 to {LONGEST_DAYS} days (got {days}).")
    now = now or datetime.now(UTC)
    authority = read(folder, CA)
    check_dates(authority, folder / f"{CA}.pem", datetime.now(UTC))
    signer = _read_key(folder, CA)
    if signer.public_key() != authority.public_key():
        raise BusError(f"'{folder / 'ca.key'}' is not the key of '{folder / 'ca.pem'}'.")
    key = ec.generate_private_key(ec.SECP256R1())
    ends = min(now + timedelta(days=days), authority.not_valid_after_utc)
    serves = participant.role == "router"
    purpose = ExtendedKeyUsageOID.SERVER_AUTH if serves else ExtendedKeyUsageOID.CLIENT_AUTH
    built = (
        _builder(_name(participant.common_name), authority.subject, key.public_key(), now - SKEW, ends)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage(digital_signature=True), critical=True)
        .add_extension(x509.ExtendedKeyUsage([purpose]), critical=False)
        .add_extension(_identifier_of(authority), critical=False)
    )
    if serves:
        names = x509.SubjectAlternativeName([_alternative(host) for host in dict.fromkeys([*HERE, *hosts])])
        built = built.add_extension(names, critical=False)
    _write_pair(folder, participant.file, built.sign(signer, hashes.SHA256()), key)
    return ends


def read(folder: Path, file: str) -> x509.Certificate:
    """The certificate `FILE.pem` of a folder.

    Raises:
        BusError: there is none, or it cannot be read.
    """
    path = folder / f"{file}.pem"
    try:
        return x509.load_pem_x509_certificate(_bytes(path))
    except ValueError as error:
        raise BusError(f"'{path}' is no certificate in PEM.") from error


def check(folder: Path, file: str, *, now: datetime | None = None) -> x509.Certificate:
    """The certificate of a participant, if a line can be opened with it: whole, signed by the authority, of today.

    Raises:
        BusError: says which file is wrong, and how.
    """
    now = now or datetime.now(UTC)
    authority, certificate = read(folder, CA), read(folder, file)
    where = folder / f"{file}.pem"
    if _read_key(folder, file).public_key() != certificate.public_key():
        raise BusError(f"'{folder / f'{file}.key'}' is not the key of '{where}'; issue the certificate again.")
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise BusError(f"'{where}' is not signed by the certificate authority of '{folder / 'ca.pem'}'.") from error
    check_dates(authority, folder / f"{CA}.pem", now)
    check_dates(certificate, folder / f"{file}.pem", now)
    return certificate


def check_dates(certificate: x509.Certificate, file: Path, now: datetime) -> None:
    """Refuse a certificate that is not valid at a time.

    Raises:
        BusError: names the file, when it ended, or begins and ends, and what time it is here.
    """
    begins, ends = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if now > ends:
        raise BusError(
            f"The certificate '{file}' expired on {told(ends)}, and it is {told(now)} now; issue a new one with "
            "thermofleet keys."
        )
    if now < begins:
        raise BusError(
            f"The certificate '{file}' is valid only from {told(begins)} to {told(ends)}, and it is {told(now)} now; "
            "is this machine's clock right?"
        )


def common_name(certificate: x509.Certificate) -> str:
    """Who a certificate is of: `arm:arm_0`; "" if it does not say."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def told(moment: datetime) -> str:
    """A moment in words: `2026-11-21 15:00 UTC`."""
    return f"{moment:%Y-%m-%d %H:%M} UTC"


def write_whole(path: Path, content: bytes, mode: int = _ALL_READ) -> None:
    """Write a file to a temporary name and rename it, so that nobody ever reads half of it.

    Raises:
        BusError: it cannot be written.
    """
    with _unfinished(path, content, mode):
        pass


def _write_pair(folder: Path, file: str, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
    """Both files are written before either gets its name."""
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    public = certificate.public_bytes(serialization.Encoding.PEM)
    with (
        _unfinished(folder / f"{file}.pem", public, _ALL_READ),
        _unfinished(folder / f"{file}.key", secret, _OWNER_ONLY),
    ):
        pass


@contextmanager
def _unfinished(path: Path, content: bytes, mode: int) -> Iterator[None]:
    """A file under a temporary name, which gets its own name when the block ends well."""
    temporary = path.with_name(f".{path.name}.{os.getpid()}.tmp")
    try:
        temporary.unlink(missing_ok=True)
        # Never for a moment more readable than it shall be.
        handle = os.open(temporary, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode)
        with os.fdopen(handle, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        yield
        os.replace(temporary, path)
    except OSError as error:
        raise BusError(f"'{path}' could not be written: {error.strerror}.") from error
    finally:
        temporary.unlink(missing_ok=True)


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise BusError(f"There is no '{path}'; thermofleet keys makes it.") from error
    except OSError as error:
        raise BusError(f"Cannot read '{path}': {error.strerror}.") from error


def _read_key(folder: Path, file: str) -> ec.EllipticCurvePrivateKey:
    path = folder / f"{file}.key"
    try:
        key = serialization.load_pem_private_key(_bytes(path), password=None)
    except (ValueError, TypeError) as error:
        raise BusError(f"'{path}' is no private key in PEM without a password.") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise BusError(f"'{path}' is no key on an elliptic curve.")
    return key


def _name(common: str) -> x509.Name:
    return x509.Name(
        [x509.NameAttribute(NameOID.ORGANIZATION_NAME, "thermofleet"), x509.NameAttribute(NameOID.COMMON_NAME, common)]
    )


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, begins: datetime, ends: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(begins)
        .not_valid_after(ends)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _identifier_of(authority: x509.Certificate) -> x509.AuthorityKeyIdentifier:
    own = authority.extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value
    return x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(own)


def _usage(*, digital_signature: bool = False, key_cert_sign: bool = False, crl_sign: bool = False) -> x509.KeyUsage:
    return x509.KeyUsage(
        digital_signature=digital_signature,
        content_commitment=False,
        key_encipherment=False,
        data_encipherment=False,
        key_agreement=False,
        key_cert_sign=key_cert_sign,
        crl_sign=crl_sign,
        encipher_only=False,
        decipher_only=False,
    )


def _alternative(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    try:
        return x509.DNSName(host)
    except ValueError as error:
        raise BusError(f"'{host}' is no host name or address; other alphabets need their punycode.") from error
