"""One machine's records: listed there, fetched, verified here, and only then released there."""

from __future__ import annotations

import contextlib
import hashlib
from collections.abc import Callable, Mapping, Sequence
from typing import Any

from cosmos_cli.fleet.board import Board
from cosmos_cli.fleet.failure import FailureKind, MachineFailure
from cosmos_cli.fleet.onboard.evidence import FILES_MAX, entry_line
from cosmos_cli.retrieve.account import Account, Retrieved
from cosmos_cli.retrieve.incoming import Incoming, PartWriter, Transfer
from cosmos_cli.retrieve.notes import Note, read_note, write_manifest, write_note
from cosmos_cli.retrieve.offer import Offer, check_offer, shown
from cosmos_cli.retrieve.sources import Source
from cosmos_cli.rundir import RunDirectory

ROUNDS_MAX = 3
"""So often a machine's files are listed anew when they changed on the way."""
FAULTS_SHOWN_MAX = 5
PATIENCE_S = 3.0
"""For what ends there at this moment, such as a sampler after its supervisor."""
PIECE_TIMEOUT_S = 30.0
RELEASE_TIMEOUT_S = 120.0
KEPT_KINDS = (FailureKind.BUSY, FailureKind.DEFECT)
"""Failures of a release that are no mere remark."""


class Changed(Exception):
    """What a machine has is no longer what it listed."""


class MachineRetrieval:
    """
    Gets one machine's part of a run.

    Args:
        run: Where to.
        source: Where from.
        owner_of: Tells whose a path in the run directory is.
        account: Counts what comes.
    """

    def __init__(
        self,
        run: RunDirectory,
        source: Source,
        *,
        owner_of: Callable[[str], str | None],
        account: Account,
    ) -> None:
        self._run = run
        self._source = source
        self._owner_of = owner_of
        self._account = account
        self._incoming = Incoming(run, source.machine)

    def go_on(self, board: Board) -> Retrieved:
        """
        Fetch what is not here yet, and have all of it released there.

        Raises:
            MachineFailure: Not all of it is here; what is stays, and the next call goes on.
        """
        reason = ""
        for _ in range(ROUNDS_MAX):
            try:
                return self._round(board)
            except Changed as error:
                reason = str(error)
        raise MachineFailure(
            FailureKind.DATA,
            f"{self._source.directory} does not stay as it was listed: {reason}",
            "see what writes there",
        )

    def _round(self, board: Board) -> Retrieved:
        listed = self._list(board)
        if listed is None:
            return self._gone()
        entries, manifest_sha256 = listed
        offer = check_offer(entries, self._source.machine, self._owner_of)
        transfers = self._open(offer)
        faults = [*offer.faults, *self._fetch(board, transfers)]
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
        return self._release(board, note)

    def _list(self, board: Board) -> tuple[list[Mapping[str, Any]], str] | None:
        """Return the machine's manifest and its hash; None when there is no such directory."""
        entries: list[Mapping[str, Any]] = []
        digest, name, is_gone = hashlib.sha256(), None, False
        arguments = {**self._where(), "patience_s": PATIENCE_S}
        for answer in board.parts("manifest", arguments, timeout_s=PATIENCE_S + PIECE_TIMEOUT_S):
            value = answer.value if isinstance(answer.value, Mapping) else {}
            is_gone = is_gone or value.get("gone") is True
            name = value.get("sha256", name)
            for entry in value.get("files") or ():
                digest.update(entry_line(entry))
                entries.append(entry if isinstance(entry, Mapping) else {})
            if len(entries) > FILES_MAX:
                text = f"{self._source.directory}: expected at most {FILES_MAX} files"
                raise MachineFailure(FailureKind.DATA, text)
        if is_gone:
            return None
        if name != digest.hexdigest():
            raise MachineFailure(FailureKind.DATA, "the list of its files is not whole")
        return entries, name

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
            if transfer.resumed_bytes and file.path not in account.fetched:
                account.resumed[file.path] = transfer.resumed_bytes
            transfers.append(transfer)
        return transfers

    def _fetch(self, board: Board, transfers: Sequence[Transfer]) -> list[str]:
        """Get what is missing of these files and put each in its place; return what kept any from it."""
        self._incoming.check_room(transfers)
        wanted = [transfer for transfer in transfers if not transfer.is_all_there]
        errors: dict[str, str] = {}
        try:
            if wanted:
                self._receive(board, wanted, errors)
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

    def _receive(self, board: Board, wanted: Sequence[Transfer], errors: dict[str, str]) -> None:
        files = [[each.file.path, each.offset, each.file.size_bytes] for each in wanted]
        arguments = {**self._where(), "files": files}
        with PartWriter(wanted, self._run.path) as writer:
            for answer in board.parts("fetch", arguments, timeout_s=PIECE_TIMEOUT_S):
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
        rest = len(faults) - FAULTS_SHOWN_MAX
        more = f"; and {rest} more" if rest > 0 else ""
        return MachineFailure(
            FailureKind.DATA,
            f"{len(faults)} of its files cannot come: {'; '.join(faults[:FAULTS_SHOWN_MAX])}{more}",
            f"all of it is kept there, see {self._source.directory}",
        )

    def _gone(self) -> Retrieved:
        note = read_note(self._run, self._source.machine)
        if note is None:
            raise MachineFailure(
                FailureKind.DATA,
                f"nothing of this run is there: {self._source.directory} does not exist,"
                " and was not retrieved from here before",
                "if its agents never started there, nothing is lost",
            )
        return self._released(note)

    def _release(self, board: Board, note: Note) -> Retrieved:
        arguments = {**self._where(), "manifest_sha256": note.manifest_sha256}
        try:
            board.call("release", arguments, timeout_s=RELEASE_TIMEOUT_S)
        except MachineFailure as failure:
            if failure.kind is FailureKind.DATA:
                raise Changed(failure.text) from failure
            if failure.kind in KEPT_KINDS:
                raise
            remark = f"it could not be deleted there: {failure.text}"
            return self._account.retrieved(is_released=False, remark=remark)
        return self._released(note)

    def _released(self, note: Note) -> Retrieved:
        write_note(self._run, self._source.machine, note.as_released())
        self._account.files, self._account.total_bytes = note.files, note.bytes
        return self._account.retrieved(is_released=True)

    def _where(self) -> dict[str, str]:
        return {"directory": self._source.directory, "state": self._source.state}
