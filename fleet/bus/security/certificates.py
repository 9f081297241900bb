"""The folder of keys of one fleet: its authority, and one certificate for each participant.

ECDSA over P-256, X.509 v3 (RFC 5280). The common name identifies the participant. The certificate of a router is
valid for listening and for links to other routers, every other one only for connecting, so no participant can act as
the router.

ca.pem ca.key        the certificate authority; its private key is needed only to issue certificates
roster.json          the participants and their roles, from which the router derives its access control
NAME.pem NAME.key    certificate and private key of each participant
"""

import ipaddress
import os
import re
import shutil
import tempfile
from collections.abc import Generator, Sequence
from contextlib import contextmanager
from datetime import UTC, datetime, timedelta
from pathlib import Path

import msgspec
from cryptography import x509
from cryptography.exceptions import InvalidSignature
from cryptography.hazmat.primitives import hashes, serialization
from cryptography.hazmat.primitives.asymmetric import ec
from cryptography.x509.oid import ExtendedKeyUsageOID, NameOID

from fleet.bus.security.access_control import LONGEST_COMMON_NAME, ROSTER, Roster, RosterEntry, read_roster
from fleet.errors import BusError
from fleet.files import atomic_path, replace_folder

CA = "ca"
"""File name of the certificate authority, without the ending."""
LONGEST_DAYS = 3650
"""Lifetime of a certificate authority; every certificate that it signs expires by then."""
SKEW = timedelta(minutes=5)
"""Certificates are valid from this long before their issue, as the clocks of machines differ."""
HERE = ("localhost", "127.0.0.1", "::1")
_HOST_NAME = re.compile(r"(?=.{1,253}$)[A-Za-z0-9_]([A-Za-z0-9_.-]*[A-Za-z0-9_])?", re.ASCII)
_OWNER_ONLY, _ALL_READ = 0o600, 0o644


def new_authority(folder: Path, fleet: str, *, now: datetime | None = None) -> None:
    """Write `ca.pem` and `ca.key`, the certificate authority of a fleet."""
    now = now or datetime.now(UTC)
    key = ec.generate_private_key(ec.SECP256R1())
    name = _name(f"{fleet} certificate authority"[-LONGEST_COMMON_NAME:])
    certificate = (
        _builder(name, name, key.public_key(), now - SKEW, now + timedelta(days=LONGEST_DAYS))
        .add_extension(x509.BasicConstraints(ca=True, path_length=0), critical=True)
        .add_extension(_usage("key_cert_sign", "crl_sign"), critical=True)
    )
    _write_pair(folder, CA, certificate.sign(key, hashes.SHA256()), key)


def issue(
    folder: Path, participant: RosterEntry, *, days: int, hosts: Sequence[str] = HERE, now: datetime | None = None
) -> datetime:
    """Write `NAME.pem` and `NAME.key` of a participant, signed by the authority in the folder.

    Args:
        hosts: Further names and addresses of the router; ignored for other roles.
        now: Start of the lifetime.

    Returns:
        When the certificate expires: after `days`, or with the authority if that is sooner.

    Raises:
        BusError: the folder has no authority that can sign, or it has expired.
    """
    certificate, key = _signed(folder, participant, days=days, hosts=hosts, now=now)
    _write_pair(folder, participant.file, certificate, key)
    return certificate.not_valid_after_utc


def _signed(
    folder: Path, participant: RosterEntry, *, days: int, hosts: Sequence[str], now: datetime | None = None
) -> tuple[x509.Certificate, ec.EllipticCurvePrivateKey]:
    """Certificate and private key of a participant, not written yet; arguments and errors as of `issue`."""
    if not 1 <= days <= LONGEST_DAYS:
        raise BusError(f"A certificate lasts 1 to {LONGEST_DAYS} days (got {days}).")
    now = now or datetime.now(UTC)
    authority = read(folder, CA)
    check_dates(authority, folder / f"{CA}.pem", datetime.now(UTC))
    signer = _read_key(folder, CA)
    if signer.public_key() != authority.public_key():
        raise BusError(f"'{folder / 'ca.key'}' is not the key of '{folder / 'ca.pem'}'.")
    key = ec.generate_private_key(ec.SECP256R1())
    expires = min(now + timedelta(days=days), authority.not_valid_after_utc)
    is_router = participant.role == "router"
    connect, listen = ExtendedKeyUsageOID.CLIENT_AUTH, ExtendedKeyUsageOID.SERVER_AUTH
    purposes = [listen, connect] if is_router else [connect]
    authority_key = authority.extensions.get_extension_for_class(x509.SubjectKeyIdentifier).value
    certificate = (
        _builder(_name(participant.common_name), authority.subject, key.public_key(), now - SKEW, expires)
        .add_extension(x509.BasicConstraints(ca=False, path_length=None), critical=True)
        .add_extension(_usage("digital_signature"), critical=True)
        .add_extension(x509.ExtendedKeyUsage(purposes), critical=False)
        .add_extension(x509.AuthorityKeyIdentifier.from_issuer_subject_key_identifier(authority_key), critical=False)
    )
    if is_router:
        names = [_host_name(host) for host in dict.fromkeys([*HERE, *hosts])]
        certificate = certificate.add_extension(x509.SubjectAlternativeName(names), critical=False)
    return certificate.sign(signer, hashes.SHA256()), key


def read(folder: Path, file: str) -> x509.Certificate:
    """The certificate `FILE.pem` of a folder.

    Raises:
        BusError: it does not exist, or cannot be read.
    """
    path = folder / f"{file}.pem"
    try:
        return x509.load_pem_x509_certificate(_bytes(path))
    except ValueError as error:
        raise BusError(f"'{path}' is not a certificate in PEM format.") from error


def check(folder: Path, file: str, *, now: datetime | None = None) -> x509.Certificate:
    """The certificate of a participant, if it is complete, signed by the authority, and valid now.

    Raises:
        BusError: names the file and what is wrong with it.
    """
    now = now or datetime.now(UTC)
    authority, certificate = read(folder, CA), read(folder, file)
    path = folder / f"{file}.pem"
    if _read_key(folder, file).public_key() != certificate.public_key():
        raise BusError(f"'{folder / f'{file}.key'}' is not the key of '{path}'; issue the certificate again.")
    try:
        certificate.verify_directly_issued_by(authority)
    except (ValueError, TypeError, InvalidSignature) as error:
        raise BusError(f"'{path}' is not signed by the certificate authority of '{folder / 'ca.pem'}'.") from error
    check_dates(authority, folder / f"{CA}.pem", now)
    check_dates(certificate, path, now)
    return certificate


def check_dates(certificate: x509.Certificate, file: Path, now: datetime) -> None:
    """Refuse a certificate that is not valid at a time.

    Raises:
        BusError: names the file, its period of validity, and the present time.
    """
    begins, expires = certificate.not_valid_before_utc, certificate.not_valid_after_utc
    if now > expires:
        raise BusError(
            f"The certificate '{file}' expired on {format_time(expires)}, and it is {format_time(now)} now; issue a "
            "new one with thermofleet bus keys."
        )
    if now < begins:
        raise BusError(
            f"The certificate '{file}' is valid only from {format_time(begins)} to {format_time(expires)}, and it is "
            f"{format_time(now)} now; is this machine's clock right?"
        )


def common_name(certificate: x509.Certificate) -> str:
    """Common name of a certificate, as `arm:arm_0`; "" for none."""
    names = certificate.subject.get_attributes_for_oid(NameOID.COMMON_NAME)
    return str(names[0].value) if names else ""


def hosts_of(certificate: x509.Certificate) -> list[str]:
    """Names and addresses of the machine for which a router's certificate is valid; none of another certificate."""
    try:
        names = certificate.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
    except x509.ExtensionNotFound:
        return []
    return [str(name.value) for name in names]


def format_time(moment: datetime) -> str:
    """As `2026-11-21 15:00 UTC`."""
    return f"{moment:%Y-%m-%d %H:%M} UTC"


@contextmanager
def written_atomically(path: Path, content: bytes, mode: int = _ALL_READ) -> Generator[None]:
    """Write a file to a temporary name; it gets its own name when the block ends without an error.

    Raises:
        BusError: it cannot be written.
    """
    try:
        with atomic_path(path) as draft:
            draft.unlink(missing_ok=True)  # of a process that was killed
            # Created with its final mode, so that a private key is never readable by others.
            with os.fdopen(os.open(draft, os.O_WRONLY | os.O_CREAT | os.O_EXCL, mode), "wb") as file:
                file.write(content)
                file.flush()
                os.fsync(file.fileno())
            yield
    except OSError as error:
        raise BusError(f"'{path}' could not be written: {error.strerror}.") from error


def _write_pair(folder: Path, file: str, certificate: x509.Certificate, key: ec.EllipticCurvePrivateKey) -> None:
    """Both files are complete before either gets its name."""
    secret = key.private_bytes(
        serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8, serialization.NoEncryption()
    )
    with (
        written_atomically(folder / f"{file}.pem", certificate.public_bytes(serialization.Encoding.PEM)),
        written_atomically(folder / f"{file}.key", secret, _OWNER_ONLY),
    ):
        pass


def _bytes(path: Path) -> bytes:
    try:
        return path.read_bytes()
    except FileNotFoundError as error:
        raise BusError(f"There is no '{path}'; {_how_to_get(path)}.") from error
    except OSError as error:
        raise BusError(f"Cannot read '{path}': {error.strerror}.") from error


def _how_to_get(path: Path) -> str:
    named = path.with_suffix("")
    if named.is_dir():
        return f"name a participant of the folder, as '{named / 'monitor'}'"
    if named.suffix in (".pem", ".key"):
        return f"leave the ending out: '{named.with_suffix('')}'"
    if path.parent.is_dir() and path.name != f"{CA}.key" and not (path.parent / f"{CA}.key").exists():
        return f"copy it from the machine that has {CA}.key, where thermofleet bus keys makes it"
    return "thermofleet bus keys makes it"


def _read_key(folder: Path, file: str) -> ec.EllipticCurvePrivateKey:
    path = folder / f"{file}.key"
    try:
        key = serialization.load_pem_private_key(_bytes(path), password=None)
    except (ValueError, TypeError) as error:
        raise BusError(f"'{path}' is not a private key in PEM format without a password.") from error
    if not isinstance(key, ec.EllipticCurvePrivateKey):
        raise BusError(f"'{path}' is not a key on an elliptic curve.")
    return key


def _name(common: str) -> x509.Name:
    return x509.Name(
        [x509.NameAttribute(NameOID.ORGANIZATION_NAME, "thermofleet"), x509.NameAttribute(NameOID.COMMON_NAME, common)]
    )


def _builder(
    subject: x509.Name, issuer: x509.Name, key: ec.EllipticCurvePublicKey, begins: datetime, expires: datetime
) -> x509.CertificateBuilder:
    return (
        x509.CertificateBuilder()
        .subject_name(subject)
        .issuer_name(issuer)
        .public_key(key)
        .serial_number(x509.random_serial_number())
        .not_valid_before(begins)
        .not_valid_after(expires)
        .add_extension(x509.SubjectKeyIdentifier.from_public_key(key), critical=False)
    )


def _usage(*allowed: str) -> x509.KeyUsage:
    every = ("digital_signature", "content_commitment", "key_encipherment", "data_encipherment", "key_agreement")
    return x509.KeyUsage(
        **{name: name in allowed for name in (*every, "key_cert_sign", "crl_sign", "encipher_only", "decipher_only")}
    )


def _host_name(host: str) -> x509.GeneralName:
    try:
        return x509.IPAddress(ipaddress.ip_address(host))
    except ValueError:
        pass
    if not _HOST_NAME.fullmatch(host):
        raise BusError(f"'{host[:255]}' is not a host name or address; other alphabets need their punycode.")
    return x509.DNSName(host)


_OWN_FILES = re.compile(rf"(.+\.(pem|key)|\.?{re.escape(ROSTER)})(\.\d+\.\d+)?")
"""Names of files in a folder of keys; those with numbers were left by a process that was killed while it wrote."""


def make(
    folder: Path, roster: Roster, *, days: int, hosts: Sequence[str] = HERE, overwrite: bool = False
) -> dict[str, datetime]:
    """Create an authority and a certificate for every participant; an error leaves the folder as it was.

    Returns:
        When each certificate expires, by name.

    Raises:
        BusError: the folder is not empty, or cannot be written.
    """
    place = Path(os.path.abspath(folder))
    _check_free(folder, overwrite)
    work: Path | None = None
    try:
        place.parent.mkdir(parents=True, exist_ok=True)
        work = Path(tempfile.mkdtemp(prefix=f".{place.name}.", dir=place.parent))  # 0700
        new_authority(work, roster.fleet)
        expires = {one.name: issue(work, one, days=days, hosts=hosts) for one in roster.participants}
        _write_roster(work, roster)
        replace_folder(work, place)
    except OSError as error:
        raise BusError(f"'{folder}' could not be written: {error.strerror}.") from error
    finally:
        if work is not None:
            shutil.rmtree(work, ignore_errors=True)
    return expires


def add(
    folder: Path,
    participants: Sequence[RosterEntry],
    *,
    days: int,
    hosts: Sequence[str] = HERE,
    overwrite: bool = False,
) -> None:
    """Issue certificates by the present authority, to new participants and, with `overwrite`, to present ones.

    Raises:
        BusError: a name is taken, or the folder cannot sign; no certificate is written.
    """
    roster, participants = read_roster(folder), list(dict.fromkeys(participants))
    present = {one.name: one for one in roster.participants}
    for one in participants:
        held = present.get(one.name, one)
        if held != one:
            raise BusError(
                f"'{one.name}' has the role {held.role} in '{folder}', not {one.role}. Choose another name for the "
                f"{one.role}."
            )
        if one.name in present and not overwrite:
            raise BusError(f"'{one.name}' has a certificate in '{folder}'; --overwrite gives it a new one.")
    new = [one for one in participants if one.name not in present]
    try:
        roster = Roster(roster.fleet, (*roster.participants, *new))
    except ValueError as error:
        raise BusError(str(error)) from error
    signed = [(one.file, *_signed(folder, one, days=days, hosts=hosts)) for one in participants]
    for file, certificate, key in signed:
        _write_pair(folder, file, certificate, key)
    _write_roster(folder, roster)


def lifetimes(folder: Path, roster: Roster) -> dict[str, tuple[datetime, datetime]]:
    """When each certificate in a folder begins and expires, by name, the authority's included.

    Participants whose certificate is on another machine are left out.

    Raises:
        BusError: one is damaged, or that of the authority is missing.
    """
    files = {one.name: one.file for one in roster.participants if (folder / f"{one.file}.pem").exists()}
    files[CA] = CA
    certificates = {name: read(folder, file) for name, file in files.items()}
    return {name: (one.not_valid_before_utc, one.not_valid_after_utc) for name, one in certificates.items()}


def key_fault(folder: Path, file: str) -> str:
    """Why the private key `FILE.key` of a folder cannot be used; "" for none, and without such a file."""
    key = folder / f"{file}.key"
    if not key.exists():
        return ""
    if not key.is_file():
        return "key is no file"
    return "key readable by others" if readable_by_others(key) else ""


def readable_by_others(key: Path) -> bool:
    """Whether other users of this machine may read a private key."""
    return os.name == "posix" and key.stat().st_mode & 0o077 != 0


def _write_roster(folder: Path, roster: Roster) -> None:
    with written_atomically(folder / ROSTER, msgspec.json.format(msgspec.json.encode(roster), indent=1) + b"\n"):
        pass


def _check_free(folder: Path, overwrite: bool) -> None:
    """Refuse a folder that holds anything but keys, or keys that `overwrite` does not allow to replace."""
    if not os.path.lexists(folder):
        return
    if not folder.is_dir() or folder.is_symlink():
        raise BusError(f"'{folder}' exists and is not a folder.")
    names = sorted(path.name for path in folder.iterdir())
    if not names:
        return
    foreign = [name for name in names if not _OWN_FILES.fullmatch(name)]
    if ROSTER not in names or foreign:
        raise BusError(f"'{folder}' is not a folder of keys: it holds '{(foreign or names)[0]}'. Choose another one.")
    if not overwrite:
        raise BusError(
            f"'{folder}' holds the keys of a fleet. --add issues one more certificate; --overwrite makes a new "
            "certificate authority, and every participant then needs a new certificate."
        )
