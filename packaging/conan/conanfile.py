# conanfile.py - RoofGS's libraries for Conan 2: conan create packaging/conan
# Builds the checkout that contains this recipe. SPDX-License-Identifier: Apache-2.0
import re
from pathlib import Path

from conan import ConanFile
from conan.tools.cmake import CMake, CMakeDeps, CMakeToolchain, cmake_layout
from conan.tools.files import copy

COMPONENTS = {"format": "rgs_format", "cameras": "rgs_cameras", "interchange": "rgs_interchange", "runtime": "rgs_runtime"}


class RoofGS(ConanFile):
    name = "roofgs"
    license = "Apache-2.0"
    description = "Compact assets and a fast renderer for 3D Gaussian splats"
    settings = "os", "arch", "compiler", "build_type"
    options = {"runtime": [True, False], "http": [True, False]}
    default_options = {"runtime": True, "http": False, "zstd/*:shared": True}
    package_type = "shared-library"

    def set_version(self):
        header = (Path(self.recipe_folder) / "../../format/include/rgs/version.hpp").read_text()
        self.version = ".".join(re.findall(r"define RGS_VERSION_(?:MAJOR|MINOR|PATCH) (\d+)", header))

    def export_sources(self):
        root = Path(self.recipe_folder).parent.parent
        for pattern in ("CMakeLists.txt", "LICENSE", "cmake/*", "format/*", "kernels/*", "runtime/*", "converter/*"):
            copy(self, pattern, root, self.export_sources_folder)

    def layout(self):
        cmake_layout(self)

    def requirements(self):
        self.requires("glm/[>=0.9.9]", transitive_headers=True)
        self.requires("tl-expected/[>=1.0]", transitive_headers=True)
        for name in ("highway/[>=1.0]", "libwebp/[>=1.2]", "libzip/[>=1.7]", "nlohmann_json/[>=3.11]", "xxhash/[>=0.8]",
                     "zlib/[>=1.2]", "zstd/[>=1.5.2]"):
            self.requires(name)
        if self.options.runtime:
            self.requires("onetbb/[>=2021.8]")
        if self.options.http:
            self.requires("libcurl/[>=7.85]")

    def generate(self):
        toolchain = CMakeToolchain(self)
        toolchain.cache_variables.update(
            BUILD_SHARED_LIBS=True, RGS_PROGRAMS=False, RGS_ENABLE_CUDA=False, RGS_WERROR=False,
            RGS_BUILD_RUNTIME=bool(self.options.runtime), RGS_ENABLE_HTTP=bool(self.options.http))
        toolchain.generate()
        CMakeDeps(self).generate()  # xxHash, libzip and libwebp are found by the modules in cmake/

    def build(self):
        cmake = CMake(self)
        cmake.configure()
        cmake.build()

    def package(self):
        CMake(self).install()
        copy(self, "LICENSE", self.source_folder, Path(self.package_folder) / "licenses")

    def package_info(self):
        self.cpp_info.set_property("cmake_find_mode", "none")  # it brings its own package rgs
        self.cpp_info.builddirs = ["lib/cmake/rgs"]
        self.cpp_info.libs = [library for name, library in COMPONENTS.items() if name != "runtime" or self.options.runtime]
