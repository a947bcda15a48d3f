"""Exits with 0 when OpenGL can be used without a screen, as the simulator does; otherwise says what is missing."""

import ctypes
import sys

PLATFORM_DEVICE = 0x313F
MOST_DEVICES = 16


def load(*names: str) -> ctypes.CDLL:
    """The first of the shared libraries ``names`` that can be loaded."""
    for name in names:
        try:
            return ctypes.CDLL(name)
        except OSError:
            continue
    sys.exit(f"none of {', '.join(names)} can be loaded")


def main() -> None:
    """Initialise a display on any EGL device."""
    load("libOpenGL.so.0", "libGL.so.1")
    egl = load("libEGL.so.1")
    egl.eglGetProcAddress.restype = ctypes.c_void_p
    egl.eglGetProcAddress.argtypes = [ctypes.c_char_p]
    query, platform_display = (
        egl.eglGetProcAddress(name) for name in (b"eglQueryDevicesEXT", b"eglGetPlatformDisplayEXT")
    )
    if not query or not platform_display:
        sys.exit("libEGL.so.1 cannot list devices")
    handle, number = ctypes.c_void_p, ctypes.c_int
    query_devices = ctypes.CFUNCTYPE(number, number, ctypes.POINTER(handle), ctypes.POINTER(number))(query)
    get_display = ctypes.CFUNCTYPE(handle, number, handle, handle)(platform_display)
    egl.eglInitialize.argtypes = [handle, handle, handle]
    devices, found = (handle * MOST_DEVICES)(), number(0)
    query_devices(MOST_DEVICES, devices, ctypes.byref(found))
    if not any(
        egl.eglInitialize(get_display(PLATFORM_DEVICE, devices[i], None), None, None) for i in range(found.value)
    ):
        sys.exit(f"no OpenGL driver works on any of the {found.value} EGL devices")


main()
