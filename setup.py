"""Build the native library with the package; everything else is in pyproject.toml."""

import importlib.util
import sys
from pathlib import Path

from setuptools import Command, Distribution, setup
from setuptools.command.bdist_wheel import bdist_wheel
from setuptools.command.build import build

ROOT = Path(__file__).parent
SPEC = importlib.util.spec_from_file_location("native_build", ROOT / "gsmerge" / "method" / "kernels" / "build.py")
native_build = sys.modules[SPEC.name] = importlib.util.module_from_spec(SPEC)
SPEC.loader.exec_module(native_build)


class BuildNative(Command):
    """Build the library of every target: beside the sources for an editable installation, else for the wheel."""

    description = "build the native library"
    user_options = ()
    editable_mode = False

    def initialize_options(self):
        self.build_lib = None

    def finalize_options(self):
        self.set_undefined_options("build", ("build_lib", "build_lib"))

    def run(self):
        folder = native_build.FOLDER if self.editable_mode else Path(self.build_lib, "gsmerge", "method", "kernels")
        wheel = self.distribution.command_obj.get("bdist_wheel")
        built = native_build.build_libraries(folder, platform=wheel.plat_name if wheel else None)
        for path in set(folder.glob("kernels-*")) - set(built):  # of an earlier build for another platform
            path.unlink()
        self.announce(f"built {', '.join(map(str, built))}", level=2)

    def get_source_files(self):
        return [str(path.relative_to(ROOT)) for path in native_build.source_files()]

    def get_outputs(self):
        return []

    def get_output_mapping(self):
        return {}


class Build(build):
    """The build of setuptools, and the library."""

    sub_commands = (*build.sub_commands, ("build_native", None))


class BuildWheel(bdist_wheel):
    """A wheel of a platform, for any version of Python: the library does not know Python."""

    def get_tag(self):
        return "py3", "none", super().get_tag()[2]


class NativeDistribution(Distribution):
    """A package with machine code in it."""

    def has_ext_modules(self):
        return True


setup(distclass=NativeDistribution, cmdclass={"build": Build, "build_native": BuildNative, "bdist_wheel": BuildWheel})
