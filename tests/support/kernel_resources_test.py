#!/usr/bin/python3
# kernel_resources_test.py - the script that reports kernels' resources, with a fake compiler.
# SPDX-License-Identifier: Apache-2.0
"""kernel_resources_test.py PROJECT_SOURCE_DIR"""
import json
import subprocess
import sys
import tempfile
from pathlib import Path

SOURCE = Path(sys.argv[1])
SCRIPT = SOURCE / "scripts/kernel_resources.py"
# An anonymous namespace, whose name differs between compilations.
SPACE = "_GLOBAL__N__0c1f5d{a}_11_turbo_a_cu_9a1b2c3d"
KERNEL = f"_ZN3rgs4cuda{len(SPACE) - 1}{SPACE}11some_kernelILi2EEEvi"  # {a} is two digits
REPORT = f"""ptxas info    : 0 bytes gmem
ptxas info    : Compiling entry function '{KERNEL}' for 'sm_{{a}}'
ptxas info    : Function properties for {KERNEL}
    {{spilled}} bytes stack frame, {{spilled}} bytes spill stores, {{spilled}} bytes spill loads
ptxas info    : Used 48 registers, used 1 barriers, {{shared}} bytes smem, 400 bytes cmem[0]
"""
PTX = f""".visible .entry {KERNEL}(
	.param .u32 {KERNEL}_param_0
)
.maxntid 256
{{
	.reg .b32 %r<2>;
}}
"""
# A compiler that accepts one architecture and no options about object files.
COMPILER = """#!/bin/sh
gives=report
for a; do case $a in -c|--generate-code*|-gencode*|-MF) echo "unexpected $a"; exit 9;;
  -arch=compute_*) arch=${a#-arch=compute_};; -code=sm_*) arch=${a#-code=sm_};; -ptx) gives=ptx;; esac; done
[ "$(cat %s/status)" = 0 ] || { echo broken; exit 1; }
sed "s/{a}/$arch/g" %s/$gives
"""
# Resident warps as cuda_occupancy.h of the toolkit computes them: architecture, threads, registers, shared bytes.
RESIDENT = {
    (75, 256, 32, 0): 32, (75, 256, 65, 0): 24, (75, 32, 16, 0): 16,  # by warps, registers, blocks
    (75, 256, 32, 32768): 16, (75, 256, 32, 32769): 8,  # two blocks and no more fill 64 KiB
    (80, 256, 33, 0): 48, (80, 32, 16, 0): 32,
    (80, 32, 80, 0): 24, (80, 192, 64, 0): 30,  # registers lie in four parts, and blocks are whole
    (86, 256, 32, 50176): 16, (86, 256, 32, 50177): 8,  # each block takes 1 KiB more
    (86, 1024, 16, 0): 32, (86, 32, 16, 0): 16, (89, 32, 16, 0): 24, (120, 32, 16, 0): 24,
    (90, 256, 48, 38112): 40, (100, 256, 48, 38112): 40, (120, 256, 48, 38112): 16, (90, 1024, 65, 0): 0,
}


def run(folder, source, spilled=0, shared=5120, status=0):
    file = folder / "kernels/src/turbo/turbo_a.cu"
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(source)
    (folder / "report").write_text(REPORT.replace("{spilled}", str(spilled)).replace("{shared}", str(shared)))
    (folder / "ptx").write_text(PTX)
    (folder / "status").write_text(str(status))
    nvcc = folder / "nvcc"
    nvcc.write_text(COMPILER % (folder, folder))
    nvcc.chmod(0o755)
    command = f"{nvcc} -I. --generate-code=arch=compute_90,code=[sm_90] -O3 -MD -MT a.o -MF a.d -x cu -c {file} -o a.o"
    (folder / "compile_commands.json").write_text(
        json.dumps([{"directory": str(folder), "command": command, "file": str(file)}]))
    done = subprocess.run([sys.executable, str(SCRIPT), "--build", str(folder), "--architectures", "75,90"],
                          capture_output=True, text=True)
    return done.returncode, done.stdout, done.stderr


def main():
    with tempfile.TemporaryDirectory() as name:
        folder = Path(name)
        plain = "__global__ void f();"
        code, out, said = run(folder, plain, spilled=32, shared=49152)
        assert code == 0, said
        assert "| turbo_a.cu | `some_kernel<2>` | 256, 49152 | 48 + 32, 8 | 48 + 32, 32 |" in out, out
        code, _, said = run(folder, plain, spilled=36)
        assert code == 1 and "some_kernel<2> spills 36 bytes on sm_75" in said, said
        code, _, said = run(folder, plain, shared=49156)
        assert code == 1 and "some_kernel<2> has 49156 bytes of shared memory on sm_90" in said, said
        code, _, said = run(folder, "extern __shared__ float values[];")
        assert code == 1 and "turbo_a.cu has shared memory of a size that only its launch knows" in said, said
        code, _, said = run(folder, plain, status=1)
        assert code == 2 and "broken" in said, said
        (folder / "compile_commands.json").unlink()
    # nvcc refuses more than 48 KiB of static memory; our kernels use no dynamic memory, which would bypass that.
    sys.path.insert(0, str(SCRIPT.parent))
    import kernel_resources
    ours = [str(file) for file in (SOURCE / "kernels/src").rglob("*.cu")]
    assert len(ours) > 10, ours
    assert not kernel_resources.dynamic_shared(ours), "see docs/develop/KERNELS.md, Limits"
    for of_kernel, warps in RESIDENT.items():
        assert kernel_resources.resident_warps(*of_kernel) == warps, of_kernel
    launch = (SOURCE / "kernels/src/common/launch.cuh").read_text()
    threads = launch[launch.index("constexpr int multiprocessor_threads()"):launch.index("/// Blocks to share")]
    for architecture, (warps, _, _) in kernel_resources.LIMITS.items():
        code = subprocess.run(["c++", "-E", "-P", "-x", "c++", f"-D__CUDA_ARCH__={10 * architecture}", "-"],
                              input=threads, capture_output=True, text=True, check=True).stdout
        assert f"return {32 * warps};" in code, (architecture, code)
    row = ("a", "1"), 8, "32, 64"
    assert list(kernel_resources.merged([row, (("b", "1"), 16, "32, 64"), (("a", "2"), 8, "40, 48")])) == [
        ("<any, 1>", {8, 16}, "32, 64"), ("<a, 2>", {8}, "40, 48")]


if __name__ == "__main__":
    main()
