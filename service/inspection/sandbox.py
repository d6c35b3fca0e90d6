"""Confinement of a process that reads hostile files: limits on files, network, processes and system calls.

Linux only, with two kernel features that need no privileges. Landlock (5.13 or newer) restricts files. A seccomp filter
restricts everything else: network, other processes, attributes of files, and parts of the kernel that no reader needs.
"""

import ctypes
import errno
import os
import platform
import resource
import struct
import sys
import sysconfig
from collections.abc import Iterable
from pathlib import Path

_PR_SET_SECCOMP, _PR_SET_NO_NEW_PRIVS = 22, 38
_FILTER_MODE = 2
_CREATE_RULESET, _ADD_RULE, _RESTRICT_SELF = 444, 445, 446  # the same on every architecture
_RULE_PATH_BENEATH = 1
_WRITE_FILE, _READ_FILE, _READ_DIR, _TRUNCATE = 1 << 1, 1 << 2, 1 << 3, 1 << 14
#: Number of file access rights by Landlock version; all of them are handled, and few are granted.
_FILE_RIGHTS = {1: 13, 2: 14, 3: 15, 4: 15}
_LATEST_FILE_RIGHTS = 16
#: Version 4 and later: rights to bind and connect TCP sockets. Version 6 and later: scopes of abstract sockets and
#: signals.
_TCP_RIGHTS, _SCOPES = 0b11, 0b11

_SYSTEM = (
    *("/usr", "/lib", "/lib64", "/etc/ld.so.cache", "/etc/localtime", "/dev/null", "/dev/zero", "/dev/urandom"),
    *("/proc/self", "/proc/cpuinfo", "/proc/meminfo", "/proc/stat", "/sys/devices/system", "/sys/fs/cgroup"),
    "/sys/kernel/mm/transparent_hugepage",
)

#: Rejected system calls, with their numbers on x86_64 and aarch64; None if aarch64 lacks the call.
_REFUSED: dict[str, tuple[int, int | None]] = {
    # network; no network descriptor is inherited either
    "socket": (41, 198), "socketpair": (53, 199), "io_uring_setup": (425, 425),
    # new programs and processes; `clone` may only create threads
    "fork": (57, None), "vfork": (58, None), "execve": (59, 221), "execveat": (322, 281), "unshare": (272, 97),
    "setns": (308, 268),
    # other processes
    "ptrace": (101, 117), "process_vm_readv": (310, 270), "process_vm_writev": (311, 271), "kcmp": (312, 272),
    "tkill": (200, 130), "rt_sigqueueinfo": (129, 138), "rt_tgsigqueueinfo": (297, 240), "pidfd_open": (434, 434),
    "pidfd_send_signal": (424, 424), "pidfd_getfd": (438, 438), "process_madvise": (440, 440),
    "process_mrelease": (448, 448), "setpriority": (141, 140), "ioprio_set": (251, 30), "migrate_pages": (256, 238),
    "move_pages": (279, 239), "setpgid": (109, 154),
    # memory that outlives a process or belongs to none
    "shmget": (29, 194), "semget": (64, 190), "msgget": (68, 186), "mq_open": (240, 180), "memfd_create": (319, 279),
    "add_key": (248, 217), "request_key": (249, 218), "keyctl": (250, 219),
    # file operations that Landlock does not cover
    "chmod": (90, None), "fchmod": (91, 52), "fchmodat": (268, 53), "fchmodat2": (452, 452), "chown": (92, None),
    "fchown": (93, 55), "lchown": (94, None), "fchownat": (260, 54), "utime": (132, None), "utimes": (235, None),
    "futimesat": (261, None), "utimensat": (280, 88), "setxattr": (188, 5), "lsetxattr": (189, 6),
    "fsetxattr": (190, 7), "removexattr": (197, 14), "lremovexattr": (198, 15), "fremovexattr": (199, 16),
    "inotify_add_watch": (254, 27), "fanotify_init": (300, 262), "open_by_handle_at": (304, 265), "acct": (163, 89),
    "quotactl": (179, 60), "mknod": (133, None), "mknodat": (259, 33),
    # mounts
    "mount": (165, 40), "umount2": (166, 39), "pivot_root": (155, 41), "chroot": (161, 51), "open_tree": (428, 428),
    "move_mount": (429, 429), "fsopen": (430, 430), "fsconfig": (431, 431), "fsmount": (432, 432),
    "fspick": (433, 433), "mount_setattr": (442, 442), "swapon": (167, 224), "swapoff": (168, 225),
    # the kernel itself
    "bpf": (321, 280), "perf_event_open": (298, 241), "userfaultfd": (323, 282), "init_module": (175, 105),
    "finit_module": (313, 273), "delete_module": (176, 106), "kexec_load": (246, 104), "kexec_file_load": (320, 294),
    "reboot": (169, 142), "syslog": (103, 116), "settimeofday": (164, 170), "clock_settime": (227, 112),
    "adjtimex": (159, 171), "clock_adjtime": (305, 266), "sethostname": (170, 161), "setdomainname": (171, 162),
    "iopl": (172, None), "ioperm": (173, None),
}  # fmt: skip
#: System calls that are rejected unless their first argument is the caller's process id, or 0 where 0 means the caller.
_OWN_ONLY: dict[str, tuple[int, int, bool]] = {
    "kill": (62, 129, False), "tgkill": (234, 131, False), "prlimit64": (302, 261, True),
    "sched_setaffinity": (203, 122, True), "sched_setscheduler": (144, 119, True), "sched_setparam": (142, 118, True),
    "sched_setattr": (314, 274, True),
}  # fmt: skip
_CLONE, _CLONE3 = (56, 220), 435
_CLONE_THREAD = 0x10000
#: `fcntl`, and its commands that name the process to which the kernel sends a descriptor's signals; any signal can be
#: chosen, such as SIGKILL.
_FCNTL, _SET_OWNER, _SET_OWNER_EXTENDED = (72, 25), 8, 15
#: Newest system call considered here; newer ones fail with ENOSYS.
_NEWEST = 462
_ARCHITECTURES = {"x86_64": (0, 0xC000003E), "aarch64": (1, 0xC00000B7)}

_LOAD, _EQUAL, _GREATER, _ANY_BIT, _RETURN = 0x20, 0x15, 0x25, 0x45, 0x06
_ALLOW, _ERRNO = 0x7FFF0000, 0x00050000
_NUMBER_AT, _ARCHITECTURE_AT, _FIRST_ARGUMENT_AT, _SECOND_ARGUMENT_AT = 0, 4, 16, 24


def missing() -> list[str]:
    """Return messages for the operator about the confinement features that this kernel lacks."""
    messages = []
    if _landlock_version() < 1:
        messages.append("Landlock (Linux 5.13): a reader that is taken over can read what this user can read")
    if not _has_seccomp():
        messages.append("seccomp filters: a reader that is taken over can use the network and signal other processes")
    return messages


def confine(readable: Iterable[Path], writable: Path | None, most_bytes: int) -> None:
    """Confine this single-threaded process permanently, as far as the kernel supports it (see `missing`).

    Args:
        readable: Files and folders that may be read recursively; missing ones are skipped.
        writable: The only file that may be written to; it must exist. None for no file.
        most_bytes: Maximum size of that file.

    Raises:
        OSError: If the kernel rejects a restriction that it supports.
    """
    resource.setrlimit(resource.RLIMIT_CORE, (0, 0))
    resource.setrlimit(resource.RLIMIT_FSIZE, (most_bytes, most_bytes))
    if not sys.platform.startswith("linux"):
        return
    _limit_processes()
    libc = ctypes.CDLL(None, use_errno=True)
    _check(libc.prctl(_PR_SET_NO_NEW_PRIVS, 1, 0, 0, 0))
    if _landlock_version() >= 1:
        _restrict_files(libc, readable, writable)
    if _has_seccomp():
        _restrict_calls(libc)


def installation() -> list[Path]:
    """Return the paths of the machine that a process needs to read: code, libraries, and hardware information."""
    packages = [entry for entry in sys.path if Path(entry).name in ("site-packages", "dist-packages", "lib-dynload")]
    library = [sysconfig.get_path(name) for name in ("stdlib", "platstdlib", "purelib", "platlib")]
    own = [Path(__file__).parents[2] / name for name in ("sgsst_core", "worker", "service")]
    return [*map(Path, dict.fromkeys([*packages, *library, *_SYSTEM])), *own]


def _limit_processes() -> None:
    """Limit this user's processes and threads to the current number on the whole machine plus 512."""
    entities = int(Path("/proc/loadavg").read_text().split("/")[1].split()[0])
    _, hard = resource.getrlimit(resource.RLIMIT_NPROC)
    most = entities + 512 if hard == resource.RLIM_INFINITY else min(hard, entities + 512)
    resource.setrlimit(resource.RLIMIT_NPROC, (most, most))


# --- Landlock ------------------------------------------------------------------------------------------------------


def _landlock_version() -> int:
    """Return the version of the kernel's Landlock; 0 if it has none."""
    if not sys.platform.startswith("linux"):
        return 0
    return max(0, int(ctypes.CDLL(None).syscall(_CREATE_RULESET, None, ctypes.c_size_t(0), ctypes.c_uint32(1))))


def _restrict_files(libc: ctypes.CDLL, readable: Iterable[Path], writable: Path | None) -> None:
    version = _landlock_version()
    rights = (1 << _FILE_RIGHTS.get(version, _LATEST_FILE_RIGHTS)) - 1
    fields = [rights, _TCP_RIGHTS, _SCOPES][: 1 + (version >= 4) + (version >= 6)]
    attributes = struct.pack(f"={len(fields)}Q", *fields)
    ruleset = _check(libc.syscall(_CREATE_RULESET, attributes, ctypes.c_size_t(len(attributes)), ctypes.c_uint32(0)))
    for path in readable:
        _allow(libc, ruleset, path, _READ_FILE | (_READ_DIR if path.is_dir() else 0))
    if writable is not None:
        _allow(libc, ruleset, writable, (_READ_FILE | _WRITE_FILE | _TRUNCATE) & rights)
    _check(libc.syscall(_RESTRICT_SELF, ctypes.c_int(ruleset), ctypes.c_uint32(0)))
    os.close(ruleset)


def _allow(libc: ctypes.CDLL, ruleset: int, path: Path, rights: int) -> None:
    try:
        descriptor = os.open(path, os.O_PATH | os.O_CLOEXEC)
    except (FileNotFoundError, PermissionError, NotADirectoryError):
        return
    try:
        rule = struct.pack("=Qi", rights, descriptor)
        _check(libc.syscall(_ADD_RULE, ctypes.c_int(ruleset), _RULE_PATH_BENEATH, rule, ctypes.c_uint32(0)))
    finally:
        os.close(descriptor)


# --- seccomp -------------------------------------------------------------------------------------------------------


def _has_seccomp() -> bool:
    """Return whether the kernel supports seccomp filters.

    If it does, installing a null filter fails with EFAULT (bad address) rather than EINVAL (unknown mode).
    """
    if not sys.platform.startswith("linux") or platform.machine() not in _ARCHITECTURES:
        return False
    libc = ctypes.CDLL(None, use_errno=True)
    return libc.prctl(_PR_SET_SECCOMP, _FILTER_MODE, None) < 0 and ctypes.get_errno() == errno.EFAULT


def _restrict_calls(libc: ctypes.CDLL) -> None:
    class Program(ctypes.Structure):
        _fields_ = (("length", ctypes.c_ushort), ("filter", ctypes.c_char_p))

    program = seccomp_program(platform.machine(), os.getpid())
    _check(libc.prctl(_PR_SET_SECCOMP, _FILTER_MODE, ctypes.byref(Program(len(program) // 8, program))))


def seccomp_program(machine: str, process: int) -> bytes:
    """Assemble the classic BPF filter of a process: all calls are allowed except those listed in this module."""
    column, architecture = _ARCHITECTURES[machine]
    refuse, absent = _ERRNO | errno.EPERM, _ERRNO | errno.ENOSYS
    code = [
        (_LOAD, 0, 0, _ARCHITECTURE_AT),
        (_EQUAL, 1, 0, architecture),
        (_RETURN, 0, 0, refuse),  # 32-bit calls have different numbers
        (_LOAD, 0, 0, _NUMBER_AT),
        (_GREATER, 0, 1, _NEWEST),  # includes x32 calls
        (_RETURN, 0, 0, absent),
        (_EQUAL, 0, 1, _CLONE3),  # flags are in memory, which a filter cannot read; the C library falls back to clone
        (_RETURN, 0, 0, absent),
        (_EQUAL, 0, 4, _CLONE[column]),
        (_LOAD, 0, 0, _FIRST_ARGUMENT_AT),
        (_ANY_BIT, 1, 0, _CLONE_THREAD),
        (_RETURN, 0, 0, refuse),
        (_RETURN, 0, 0, _ALLOW),
        (_EQUAL, 0, 5, _FCNTL[column]),
        (_LOAD, 0, 0, _SECOND_ARGUMENT_AT),
        (_EQUAL, 2, 0, _SET_OWNER),
        (_EQUAL, 1, 0, _SET_OWNER_EXTENDED),
        (_RETURN, 0, 0, _ALLOW),
        (_RETURN, 0, 0, refuse),
    ]
    for *numbers, zero_is_own in _OWN_ONLY.values():
        code += [
            (_EQUAL, 0, 5, numbers[column]),
            (_LOAD, 0, 0, _FIRST_ARGUMENT_AT),
            (_EQUAL, 2, 0, process),
            (_EQUAL, 1, 0, 0 if zero_is_own else process),
            (_RETURN, 0, 0, refuse),
            (_RETURN, 0, 0, _ALLOW),
        ]
    for refused in _REFUSED.values():
        number = refused[column]
        if number is not None:
            code += [(_EQUAL, 0, 1, number), (_RETURN, 0, 0, refuse)]
    code.append((_RETURN, 0, 0, _ALLOW))
    return b"".join(struct.pack("=HBBI", *instruction) for instruction in code)


def _check(result: int) -> int:
    if result < 0:
        raise OSError(ctypes.get_errno(), os.strerror(ctypes.get_errno()))
    return result
