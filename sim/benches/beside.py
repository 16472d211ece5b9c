#!/usr/bin/env python3
"""Our arm beside Pinocchio (C++, no Python in between) and MuJoCo: the same descriptions, one run, as ratios.

    pip install numpy pin cmeel-eigen mujoco
    python3 sim/benches/beside.py

Pinocchio's half needs g++ and Debian's liburdfdom-headers-dev (the wheel leaves these headers out) and is compiled into a temporary folder with -O3. MuJoCo steps a hundred milliseconds a call; its step is 1 ms, ours are four of
0.25 ms. What is not installed is left out and said. One thread on either side; on a shared machine read the ratio."""
import json, os, re, subprocess, sys, sysconfig, tempfile, time

here = os.path.dirname(os.path.abspath(__file__))
root = os.path.join(here, "..", "..")
ARMS = {"6": "ur5_like", "7": "arm7"}
scratch = tempfile.mkdtemp(prefix="telemime-beside-")
urdf = {}
for axes, name in ARMS.items():
    with open(os.path.join(root, "tests", "vectors", f"rigid_{name}.json")) as f:
        text = json.load(f)["urdf"]
    urdf[axes] = os.path.join(scratch, name + ".urdf")
    with open(urdf[axes], "w") as f:
        f.write(text)


def ours():
    """median seconds by bench and axes"""
    out = subprocess.run(["cargo", "bench", "-q", "-p", "telemime-sim", "--bench", "arm"],
                         cwd=root, stdout=subprocess.PIPE, text=True, check=True).stdout
    unit = {"ns": 1e-9, "µs": 1e-6, "ms": 1e-3}
    found, group = {}, ""
    for line in out.splitlines():
        head = re.match(r"[├╰]─ (\w+)", line)
        if head:
            group = head.group(1)
        times = re.findall(r"([\d.]+) (ns|µs|ms)", line)
        axes = re.match(r"[│ ]\s+[├╰]─ (\d+)", line)
        if len(times) >= 4:
            name = f"{group}_{axes.group(1)}" if axes else group
            found[name] = float(times[2][0]) * unit[times[2][1]]
    return found


def pinocchio():
    prefix = os.path.join(sysconfig.get_paths()["purelib"], "cmeel.prefix")
    if not os.path.isdir(os.path.join(prefix, "include", "eigen3")):
        print("note: pin and cmeel-eigen are not installed: no Pinocchio", file=sys.stderr)
        return {}
    program = os.path.join(scratch, "beside")
    libs = os.path.join(prefix, "lib")
    subprocess.run(["g++", "-O3", "-DNDEBUG", "-std=c++17", "-w",
                    # As its CMake package has it: more kinds of joints than the boost lists hold by default.
                    "-DBOOST_MPL_CFG_NO_PREPROCESSED_HEADERS", "-DBOOST_MPL_LIMIT_LIST_SIZE=40", "-DBOOST_MPL_LIMIT_VECTOR_SIZE=40",
                    "-DBOOST_FUSION_INVOKE_MAX_ARITY=10", os.path.join(here, "beside.cpp"), "-o", program,
                    "-I" + os.path.join(prefix, "include"), "-I" + os.path.join(prefix, "include", "eigen3"),
                    "-I/usr/include/urdfdom_headers", "-L" + libs, "-Wl,-rpath," + libs, "-lpinocchio_default", "-lpinocchio_parsers",
                    "-lboost_filesystem", "-lboost_serialization"], check=True)
    found = {}
    for axes in ARMS:
        out = subprocess.run([program, urdf[axes], axes], stdout=subprocess.PIPE, text=True, check=True).stdout
        found.update((k, float(v)) for k, v in (line.split(",") for line in out.split()))
    return found


def mujoco():
    try:
        import mujoco as mj
    except ImportError:
        print("note: mujoco is not installed", file=sys.stderr)
        return {}
    found = {}
    for axes in ARMS:
        m = mj.MjModel.from_xml_path(urdf[axes])
        m.opt.timestep = 1e-3
        m.opt.disableflags |= int(mj.mjtDisableBit.mjDSBL_CONTACT) | int(mj.mjtDisableBit.mjDSBL_CONSTRAINT)
        m.dof_damping[:] = 2.0
        d = mj.MjData(m)
        for rule, name in ((mj.mjtIntegrator.mjINT_EULER, "tick_euler"), (mj.mjtIntegrator.mjINT_RK4, "tick_rk4")):
            m.opt.integrator = rule
            mj.mj_resetData(m, d)
            rounds = []
            for _ in range(15):
                begin = time.perf_counter()
                for _ in range(20):
                    mj.mj_step(m, d, nstep=100)
                rounds.append((time.perf_counter() - begin) / 2000)
            found[f"{name}_{axes}"] = sorted(rounds)[7]
    return found


mine, theirs = ours(), {}
theirs.update((k, ("Pinocchio", v)) for k, v in pinocchio().items())
theirs.update((k, ("MuJoCo", v)) for k, v in mujoco().items())
print("| what | axes | ours | beside | ratio |\n|---|---|---|---|---|")
for name, (who, seconds) in theirs.items():
    what, axes = name.rsplit("_", 1)
    print(f"| {what} | {axes} | {mine[name] * 1e6:.2f} µs | {who} {seconds * 1e6:.2f} µs | {mine[name] / seconds:.2f} |")
