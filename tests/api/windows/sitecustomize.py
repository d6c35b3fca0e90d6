"""Start of Windows' Python under Wine 8: its packages, and functions of complex numbers that Wine's C library lacks.

NumPy and Numba call them. Wine has stubs in their place, which end the process; their machine code is written there.
"""

import ctypes
import os
import site
import sys

#: x86-64 code by function, in Microsoft's calling convention: a complex double is passed by address, in rcx, and a
#: complex float by value.
CODE = {
    "creal": "f20f1001c3",  # movsd xmm0, [rcx]; ret
    "cimag": "f20f104108c3",  # movsd xmm0, [rcx + 8]; ret
    "crealf": "660f6ec1c3",  # movd xmm0, ecx; ret
    "cimagf": "48c1e920660f6ec1c3",  # shr rcx, 32; movd xmm0, ecx; ret
}
_READ_WRITE_EXECUTE = 0x40

site.addsitedir(os.path.join(os.path.dirname(sys.executable), "..", "site"))
kernel = ctypes.WinDLL("kernel32")  # type: ignore[attr-defined]
kernel.GetModuleHandleW.restype = kernel.GetProcAddress.restype = ctypes.c_void_p
kernel.GetProcAddress.argtypes = ctypes.c_void_p, ctypes.c_char_p
kernel.VirtualProtect.argtypes = ctypes.c_void_p, ctypes.c_size_t, ctypes.c_uint32, ctypes.c_void_p
for name, code in CODE.items():
    address = kernel.GetProcAddress(kernel.GetModuleHandleW("ucrtbase.dll"), name.encode())
    earlier = ctypes.c_uint32()
    if address and kernel.VirtualProtect(address, 16, _READ_WRITE_EXECUTE, ctypes.byref(earlier)):
        ctypes.memmove(address, bytes.fromhex(code), len(code) // 2)
