"""Programs of kiteline as processes forked from one that has all loaded.

Loading modules and kernels takes an agent or a base 2 s of CPU, a flight of the tests less than half a second. What
follows the loading is the same as in a process of its own: arguments, environment, pipes, signals, exit status.
"""

import contextlib
import ctypes
import gc
import json
import os
import signal
import socket
import subprocess
import sys
import traceback
from collections.abc import Callable, Sequence

_SUBREAPER = 36  # PR_SET_CHILD_SUBREAPER of prctl(2): children of a process that has ended become ours
_MESSAGE_BYTES = 200_000
_start = subprocess.Popen  # itself, where a test has put ForkedProgram in its place


def _cli() -> object:
    from kiteline_cli.entry import run

    return run()


def _agent() -> object:
    from kiteline_agent.__main__ import main

    raise SystemExit(main())


def _base() -> object:
    from kiteline_basestation.__main__ import main

    raise SystemExit(main())


PROGRAMS: dict[str, Callable[[], object]] = {
    "kiteline_cli": _cli, "kiteline_agent": _agent, "kiteline_basestation": _base,
}  # fmt: skip


class ForkedProgram(subprocess.Popen[str]):
    """A process like that of subprocess.Popen. `python -m PROGRAM …` is forked, any other command starts as usual."""

    # The arguments of Popen's own method. Children of a forked process are not ours, so that it ends in between.
    def _execute_child(
        self, args: Sequence[str], executable: object, preexec_fn: object, close_fds: object, pass_fds: object,
        cwd: object, env: dict[str, str] | None, startupinfo: object, creationflags: object, shell: object,
        p2cread: int, p2cwrite: int, c2pread: int, c2pwrite: int, errread: int, errwrite: int,
        restore_signals: object, gid: object, gids: object, uid: object, umask: object, start_new_session: object,
        *more: object,
    ) -> None:  # fmt: skip
        words = args if isinstance(args, (list, tuple)) else ()
        if words[:2] != [sys.executable, "-m"] or words[2] not in PROGRAMS or cwd is not None or preexec_fn is not None:
            super()._execute_child(  # type: ignore[misc]
                args, executable, preexec_fn, close_fds, pass_fds, cwd, env, startupinfo, creationflags, shell, p2cread,
                p2cwrite, c2pread, c2pwrite, errread, errwrite, restore_signals, gid, gids, uid, umask,
                start_new_session, *more,
            )  # fmt: skip
            return
        pipes = [p2cread, c2pwrite, errwrite]
        files = [inherited if pipe == -1 else pipe for inherited, pipe in enumerate(pipes)]
        try:
            self.pid = _origin().fork(
                words[2:], dict(os.environ if env is None else env), bool(start_new_session), files
            )
            self._child_created = True
        finally:
            self._close_pipe_fds(p2cread, p2cwrite, c2pread, c2pwrite, errread, errwrite)  # type: ignore[attr-defined]


class _Origin:
    """The process that has all loaded."""

    def __init__(self) -> None:
        ctypes.CDLL(None).prctl(_SUBREAPER, 1, 0, 0, 0)
        self._socket, theirs = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        environment = {**os.environ, "PYTHONPATH": os.pathsep.join(entry for entry in sys.path if entry)}
        code = "import sys; from tests.forked_programs import serve; serve(int(sys.argv[1]))"
        with theirs:
            self._process = _start(
                [sys.executable, "-c", code, str(theirs.fileno())], env=environment, pass_fds=(theirs.fileno(),)
            )

    def fork(self, words: Sequence[str], environment: dict[str, str], new_session: bool, files: Sequence[int]) -> int:
        """Fork `-m words`; the process id, of a child of this process."""
        message = json.dumps([list(words), environment, new_session]).encode()
        socket.send_fds(self._socket, [message], files)
        return int(self._socket.recv(64))

    def close(self) -> None:
        self._socket.close()
        self._process.wait(10.0)


_origins: list[_Origin] = []


def _origin() -> _Origin:
    if not _origins:
        _origins.append(_Origin())
    return _origins[0]


def end() -> None:
    """End the process that has all loaded, if there is one; what was forked runs on."""
    while _origins:
        _origins.pop().close()


def serve(number: int) -> None:
    """Load all, then fork a program for each message, until the tests' process ends."""
    import cv2

    import kiteline_agent.__main__
    import kiteline_agent.config
    import kiteline_agent.runtime.warm
    import kiteline_basestation.__main__
    import kiteline_basestation.config
    import kiteline_basestation.runtime.warm
    import kiteline_basestation.web.status_page
    import kiteline_codec.warm

    cv2.setNumThreads(1)  # a process with threads cannot be forked
    kiteline_codec.warm.warm()
    kiteline_agent.runtime.warm.warm(kiteline_agent.config.AgentConfig())
    kiteline_basestation.runtime.warm.warm(kiteline_basestation.config.BaseConfig())
    gc.collect()
    gc.freeze()
    assert len(os.listdir("/proc/self/task")) == 1
    with socket.socket(fileno=number) as link:
        while True:
            message, files, _, _ = socket.recv_fds(link, _MESSAGE_BYTES, 3)
            if not message:
                return
            words, environment, new_session = json.loads(message)
            read_end, write_end = os.pipe()
            between = os.fork()
            if between == 0:
                program = os.fork()
                if program:
                    os.write(write_end, str(program).encode())
                    os._exit(0)
                for one in (read_end, write_end):
                    os.close(one)
                link.close()
                _run(words, environment, new_session, files)
            os.waitpid(between, 0)
            link.send(os.read(read_end, 64))
            for one in (*files, read_end, write_end):
                os.close(one)


def _run(words: Sequence[str], environment: dict[str, str], new_session: bool, files: Sequence[int]) -> None:
    """Become the program."""
    status = 1
    try:
        if new_session:
            os.setsid()
        for wanted, file in enumerate(files):
            os.dup2(file, wanted)
        for file in files:
            os.close(file)
        signal.signal(signal.SIGINT, signal.default_int_handler)
        os.environ.clear()
        os.environ.update(environment)
        sys.argv = list(words)
        PROGRAMS[words[0]]()
        status = 0
    except SystemExit as end:
        status = end.code if isinstance(end.code, int) else 0 if end.code is None else 1
    except BaseException:
        traceback.print_exc()
    finally:
        for stream in (sys.stdout, sys.stderr):
            with contextlib.suppress(OSError, ValueError):
                stream.flush()
        os._exit(status)
