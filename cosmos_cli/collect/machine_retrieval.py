"""One machine's records: listed there, fetched and counted, verified here, and only then released there."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

from cosmos_cli.collect.machine_sources import RecordingMachine
from cosmos_cli.collect.partial_files import PartialFiles, PartWriter, Transfer
from cosmos_cli.collect.remote_manifest import Offer, check_offer, shown
from cosmos_cli.collect.retrieval_state import Note, read_note, write_manifest, write_note
from cosmos_cli.collect.size_bound import SizedFile, check_sizes, hash_deadline_s
from cosmos_cli.evidence.run_directory import RunDirectory
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.helper import Answer, Helper
from cosmos_cli.onboard.records import FILES_MAX, entry_line
from cosmos_cli.ui.plural import counted
from cosmos_cli.ui.sizes import size_words
from madns_runtime.plain_values import first_few

ROUNDS_MAX = 3
"""Rounds at most; a machine's files are listed anew in each, where they changed on the way."""
FAULTS_SHOWN_MAX = 5
PATIENCE_S = 30.0
"""Wait for what ends there at this moment, such as a sampler after its supervisor, on a busy board with a slow card."""
PIECE_TIMEOUT_S = 30.0
SIZES_TIMEOUT_S = 300.0
"""Time for the sizes of FILES_MAX files on a slow card."""
STANDSTILL_S = 120.0
"""Time in which a transfer may bring nothing; as long as it brings something it goes on."""
RELEASE_TIMEOUT_S = 120.0
KEPT_KINDS = (FailureKind.BUSY, FailureKind.DEFECT)
"""Failures of a release that are no mere remark."""


class Changed(Exception):
    """Difference between a machine's files and its own list of them."""


class RecordsKept(MachineFailure):
    """Some of a machine's records are damaged or may not come; the machine itself is well, and the rest is here."""


@dataclass(frozen=True, slots=True, kw_only=True)
class Retrieved:
    """One machine's records: all of them are here, verified, on the disk."""

    files: int
    bytes: int
    fetched_files: int = 0
    """Number of these that came this time."""
    fetched_bytes: int = 0
    packed_bytes: int = 0
    """The fetched bytes as they came over the wire."""
    resumed_bytes: int = 0
    """Bytes of files that came this time which an earlier collection had brought."""
    is_released: bool = True
    remark: str = ""
    """Why all of it still lies there as well; empty if it does not."""

    def to_mapping(self) -> dict[str, Any]:
        """Return plain values for --json."""
        return asdict(self)

    @property
    def words(self) -> str:
        """Account in words."""
        if self.fetched_files:
            wire = (
                f"{size_words(self.fetched_bytes)} ({size_words(self.packed_bytes)} over the wire)"
            )
            resumed = (
                f", resumed after {size_words(self.resumed_bytes)}" if self.resumed_bytes else ""
            )
            told = f"{self.fetched_files} of {counted(self.files, 'file')}, {wire}{resumed}"
        else:
            told = f"{counted(self.files, 'file')}, {size_words(self.bytes)}, here already"
        return told + (f"; {self.remark}" if self.remark else "")


@dataclass(slots=True)
class TransferAccount:
    """Account of all that has come from one machine so far, over all its connections and rounds."""

    told: Callable[[int, int], None] = lambda here_bytes, total_bytes: None
    """Takes how many bytes are here, and how many there are."""
    files: int = 0
    total_bytes: int = 0
    here_files: int = 0
    here_bytes: int = 0
    fetched_bytes: int = 0
    packed_bytes: int = 0
    fetched: set[str] = field(default_factory=set)
    resumed: dict[str, int] = field(default_factory=dict)

    def open(self, path: str, there_bytes: int) -> None:
        """Note what is here of a file, each time that its transfer begins or goes on; what came meanwhile is fetched."""
        if path not in self.fetched:
            self.resumed[path] = min(there_bytes, self.resumed.get(path, there_bytes))

    def piece(self, size_bytes: int, packed_bytes: int) -> None:
        """Count a piece that has come."""
        self.fetched_bytes += size_bytes
        self.packed_bytes += packed_bytes
        self.here_bytes += size_bytes
        self.told(self.here_bytes, self.total_bytes)

    @property
    def so_far(self) -> str:
        """Progress for the text of a failure; empty before anything is known."""
        if not self.files:
            return ""
        here, total = size_words(self.here_bytes), size_words(self.total_bytes)
        return f" ({self.here_files} of {self.files} files and {here} of {total} are here)"

    def retrieved(self, *, is_released: bool, remark: str = "") -> Retrieved:
        """Return the account when everything has come."""
        return Retrieved(
            files=self.files,
            bytes=self.total_bytes,
            fetched_files=len(self.fetched),
            fetched_bytes=self.fetched_bytes,
            packed_bytes=self.packed_bytes,
            resumed_bytes=sum(self.resumed.values()),
            is_released=is_released,
            remark=remark,
        )


class MachineRetrieval:
    """
    Gets one machine's part of a run.

    Args:
        run: Where to.
        source: Where from.
        owner_of: Tells whose a path in the run directory is.
        account: Counts what comes.
        bytes_max: What it can have recorded of the run.
    """

    def __init__(
        self,
        run: RunDirectory,
        source: RecordingMachine,
        *,
        owner_of: Callable[[str], str | None],
        account: TransferAccount,
        bytes_max: int,
    ) -> None:
        self._run = run
        self._source = source
        self._owner_of = owner_of
        self._account = account
        self._bytes_max = bytes_max
        self._incoming = PartialFiles(run, source.machine)

    def go_on(self, helper: Helper) -> Retrieved:
        """
        Fetch what is not here yet, and have all of it released there.

        Raises:
            MachineFailure: Not all of it is here; what is stays, and the next call goes on.
        """
        reason = ""
        for _ in range(ROUNDS_MAX):
            try:
                return self._round(helper)
            except Changed as error:
                reason = str(error)
        raise MachineFailure(
            FailureKind.DATA,
            f"{self._source.directory} does not stay as it was listed: {reason}",
            "see what writes there",
        )

    def _round(self, helper: Helper) -> Retrieved:
        sizes = self._ask_sizes(helper)
        if sizes is None:
            return self._gone()
        # Before a byte is read there: a file may say to be larger than any disk.
        check_sizes(sizes, self._bytes_max, self._source.directory, run=self._run.shell_path)
        self._incoming.check_room_for(sizes)
        listed = self._list(helper, sizes)
        if listed is None:
            return self._gone()
        entries, manifest_sha256 = listed
        offer = check_offer(entries, self._source.machine, self._owner_of)
        transfers = self._open(offer)
        faults = [*offer.faults, *self._fetch(helper, transfers)]
        if faults:
            raise self._refusal(faults)
        came = {transfer.file for transfer in transfers}
        self._incoming.settle([file for file in offer.files if file not in came])
        write_manifest(self._run, self._source.machine, entries, manifest_sha256)
        note = Note(
            state="verified",
            directory=self._source.directory,
            manifest_sha256=manifest_sha256,
            files=len(offer.files),
            bytes=offer.size_bytes,
        )
        write_note(self._run, self._source.machine, note)
        self._incoming.tidy()
        return self._release(helper, note)

    def _ask_sizes(self, helper: Helper) -> list[SizedFile] | None:
        """Return what there is and how large; None when there is no such directory."""
        sizes: list[SizedFile] = []
        arguments = {**self._source.where, "patience_s": PATIENCE_S}
        timeout_s = PATIENCE_S + PIECE_TIMEOUT_S
        for answer in helper.pieces(
            "sizes", arguments, timeout_s=timeout_s, whole_s=PATIENCE_S + SIZES_TIMEOUT_S
        ):
            if answer.value.get("gone") is True:
                return None
            found = (SizedFile(shown(path), size) for path, size in answer.value.get("sizes") or ())
            sizes += found
            if len(sizes) > FILES_MAX:
                raise self._too_many()
        return sizes

    def _list(
        self, helper: Helper, sizes: Sequence[SizedFile]
    ) -> tuple[list[Mapping[str, Any]], str] | None:
        """Return the machine's manifest and its hash; None when there is no such directory."""
        entries: list[Mapping[str, Any]] = []
        digest, name, is_gone = hashlib.sha256(), None, False
        arguments = {
            **self._source.where,
            "patience_s": PATIENCE_S,
            "bytes_max": self._bytes_max,
        }
        for answer in self._hashed(helper, arguments, sizes):
            value = answer.value if isinstance(answer.value, Mapping) else {}
            is_gone = is_gone or value.get("gone") is True
            name = value.get("sha256", name)
            for entry in value.get("files") or ():
                digest.update(entry_line(entry))
                entries.append(entry if isinstance(entry, Mapping) else {})
            if len(entries) > FILES_MAX:
                raise self._too_many()
        if is_gone:
            return None
        if name != digest.hexdigest():
            raise MachineFailure(FailureKind.DATA, "the list of its files is not whole")
        return entries, name

    def _hashed(
        self, helper: Helper, arguments: Mapping[str, Any], sizes: Sequence[SizedFile]
    ) -> Iterator[Answer]:
        """Have all files read and hashed there, in the time that so much may take."""
        total = sum(file.size_bytes for file in sizes)
        whole_s, timeout_s = hash_deadline_s(len(sizes), total), PATIENCE_S + PIECE_TIMEOUT_S
        try:
            yield from helper.pieces("manifest", arguments, timeout_s=timeout_s, whole_s=whole_s)
        except MachineFailure as failure:
            if failure.kind is not FailureKind.TIMEOUT:
                raise
            raise MachineFailure(
                FailureKind.TIMEOUT,
                f"reading {counted(len(sizes), 'file')} of {self._source.directory},"
                f" {size_words(total)}: {failure.text}",
                f"is its card failing? repeat with: cosmos collect {self._run.shell_path}",
            ) from failure

    def _too_many(self) -> MachineFailure:
        return MachineFailure(
            FailureKind.DATA, f"{self._source.directory}: expected at most {FILES_MAX} files"
        )

    def _open(self, offer: Offer) -> list[Transfer]:
        """Return what is not here yet, and put into the account what is."""
        account = self._account
        account.files, account.total_bytes = len(offer.files), offer.size_bytes
        account.here_files = account.here_bytes = 0
        transfers = []
        for file in offer.files:
            transfer = self._incoming.open_transfer(file)
            if transfer is None:
                account.here_files += 1
                account.here_bytes += file.size_bytes
                continue
            account.here_bytes += transfer.offset
            account.open(file.path, transfer.resumed_bytes)
            transfers.append(transfer)
        return transfers

    def _fetch(self, helper: Helper, transfers: Sequence[Transfer]) -> list[str]:
        """Get what is missing of these files and put each in its place; return what kept any from it."""
        self._incoming.check_room(transfers)
        wanted = [transfer for transfer in transfers if not transfer.is_all_there]
        errors: dict[str, str] = {}
        try:
            if wanted:
                self._receive(helper, wanted, errors)
        except MachineFailure:
            # What is whole stays and is judged, although the rest did not come.
            with contextlib.suppress(MachineFailure):
                self._install(transfers)
            raise
        faults = self._install(transfers)
        for each in transfers:
            path = each.file.path
            if not each.is_whole:
                what = errors.get(path) or "it came with another content"
                raise Changed(f"{path}: {what}")
        return faults

    def _receive(self, helper: Helper, wanted: Sequence[Transfer], errors: dict[str, str]) -> None:
        files = [[each.file.path, each.offset, each.file.size_bytes] for each in wanted]
        arguments = {**self._source.where, "files": files}
        with PartWriter(wanted, self._run.path) as writer:
            for answer in helper.pieces(
                "fetch", arguments, timeout_s=PIECE_TIMEOUT_S, whole_s=STANDSTILL_S
            ):
                value = answer.value if isinstance(answer.value, Mapping) else {}
                index = value.get("file")
                if "error" in value and isinstance(index, int) and 0 <= index < len(wanted):
                    errors[wanted[index].file.path] = shown(str(value["error"]))
                    continue
                self._account.piece(writer.write(value, answer.body), len(answer.body))

    def _install(self, transfers: Sequence[Transfer]) -> list[str]:
        faults = self._incoming.install(transfers)
        whole = [each.file.path for each in transfers if each.is_whole]
        self._account.fetched.update(whole)
        self._account.here_files += len(whole)
        return faults

    def _refusal(self, faults: Sequence[str]) -> MachineFailure:
        return RecordsKept(
            FailureKind.DATA,
            f"{len(faults)} of its files cannot come: {first_few(faults, FAULTS_SHOWN_MAX, '; ')}",
            f"all of it is kept there, see {self._source.directory}",
        )

    def _gone(self) -> Retrieved:
        note = read_note(self._run, self._source.machine)
        if note is None:
            raise MachineFailure(
                FailureKind.DATA,
                f"nothing of this run is there: {self._source.directory} does not exist,"
                " and was not retrieved from here before",
                "if its agents never started there, nothing is lost, else a power cut or a deletion took it: give it up"
                f" with: cosmos collect {self._run.shell_path} --forget {self._source.machine}",
            )
        return self._released(note)

    def _release(self, helper: Helper, note: Note) -> Retrieved:
        arguments = {**self._source.where, "manifest_sha256": note.manifest_sha256}
        try:
            helper.call("release", arguments, timeout_s=RELEASE_TIMEOUT_S)
        except MachineFailure as failure:
            if failure.kind is FailureKind.DATA:
                raise Changed(failure.text) from failure
            if failure.kind in KEPT_KINDS:
                raise
            return self._account.retrieved(
                is_released=False, remark=f"it could not be deleted there: {failure.text}"
            )
        return self._released(note)

    def _released(self, note: Note) -> Retrieved:
        write_note(self._run, self._source.machine, note.in_state("released"))
        self._account.files, self._account.total_bytes = note.files, note.bytes
        return self._account.retrieved(is_released=True)
