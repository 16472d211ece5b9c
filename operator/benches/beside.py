#!/usr/bin/env python3
"""Our mixtures beside scikit-learn's and gmr's: the same data, the same start, one run, as ratios.

    pip install numpy scikit-learn gmr
    TELEMIME_DATA=DIR python3 operator/benches/beside.py [--all]

DIR/peers holds the peers' scripts (data.py, _peer.py, bench_*.py); their data go to a temporary folder. One thread on
either side. --all adds 50000 x 4 and 100000 x 7, which take scikit-learn minutes. Timings on a shared machine move by
a factor; both sides move together, so read the ratio."""
import os, re, subprocess, sys, tempfile

here = os.path.dirname(os.path.abspath(__file__))
root = os.path.join(here, "..", "..")
shared = os.environ.get("TELEMIME_DATA", os.path.join(root, "..", "shared"))
peers = os.path.join(shared, "peers")
if not os.path.isdir(peers):
    sys.exit(f"{peers} is not there: set TELEMIME_DATA to the folder that holds peers/")
scratch = os.environ.get("PEER_DATA") or os.path.join(tempfile.gettempdir(), "telemime-peers")
everything = "--all" in sys.argv[1:]
one = dict(os.environ, PEER_DATA=scratch, OMP_NUM_THREADS="1", OPENBLAS_NUM_THREADS="1", RAYON_NUM_THREADS="1", PYTHONDONTWRITEBYTECODE="1")
sizes = ["500,4,3", "5000,4,10"] + (["50000,4,10", "100000,7,20"] if everything else [])


def peer(script, *args):
    """median seconds by name (with sizes)"""
    out = subprocess.run([sys.executable, script, *args], cwd=peers, env=one, stdout=subprocess.PIPE, stderr=subprocess.DEVNULL, text=True)
    if out.returncode:
        print(f"note: {script} did not run (is its package installed?)", file=sys.stderr)
    rows = [line.rsplit(",", 1) for line in out.stdout.splitlines() if line.count(",") == 4]
    return {name: float(seconds) for name, seconds in rows}


def ours(pattern):
    """median seconds by name of the bench"""
    out = subprocess.run(["cargo", "bench", "-q", "-p", "telemime-operator", "--bench", "mixtures", "--", pattern],
                         cwd=root, env=one, stdout=subprocess.PIPE, text=True, check=True).stdout
    unit = {"ns": 1e-9, "µs": 1e-6, "ms": 1e-3, "s": 1.0}
    found, group = {}, ""
    for line in out.splitlines():
        indented = line.startswith(("│", " "))
        name = re.search(r"[├╰]─ (\S+)", line)
        times = re.findall(r"([\d.]+) (ns|µs|ms|s)\b", line)
        if not name:
            continue
        if len(times) < 4:
            group = name[1]
            continue
        value, scale = times[2]
        found[f"{group} {name[1]}" if indented else name[1]] = float(value) * unit[scale]
    return found


theirs = {}
subprocess.run([sys.executable, "data.py"], cwd=peers, env=one, check=True)
for size in sizes:
    theirs |= peer("bench_sklearn_gmm.py", "fixed", size)
theirs |= peer("bench_sklearn_bic.py")
theirs |= peer("bench_gmr.py")
mine = ours("") if everything else {name: t for pattern in ("500_4_3", "5000_4_10", "bic_grid", "gmr") for name, t in ours(pattern).items()}

pairs = [(f"sklearn_gmm_30iter_t1,{s}", "em_30_iterations_" + s.replace(",", "_")) for s in sizes]
pairs += [("sklearn_bic_grid_1to15_tol0.001_t1,3000,4,15", "bic_grid_3000_4_15 0.001"),
          ("sklearn_bic_grid_1to15_tol1e-06_t1,3000,4,15", "bic_grid_3000_4_15 0.000001"),
          ("gmr_condition_one_mean_cov,1,4,10", "gmr_one_query_mean_and_covariance"),
          ("numpy_gmr_one_mean_cov,1,4,10", "gmr_one_query_mean_and_covariance"),
          ("gmr_predict_batch,1000,4,10", "gmr_1000_queries_mean_and_covariance"),
          ("numpy_gmr_batch_mean_cov,1000,4,10", "gmr_1000_queries_mean_and_covariance")]
print(f"{'peer (N, D, K)':<48}{'peer, ms':>12}{'ours, ms':>12}{'ratio':>9}")
for peer_name, our_name in pairs:
    a, b = theirs.get(peer_name), mine.get(our_name)
    if a is None or b is None:
        print(f"{peer_name:<48}{'missing' if a is None else f'{a * 1e3:.5g}':>12}{'missing' if b is None else f'{b * 1e3:.5g}':>12}")
    else:
        print(f"{peer_name:<48}{a * 1e3:>12.5g}{b * 1e3:>12.5g}{a / b:>8.0f}x")
