//! What there is to know of the host alone.

use std::fs;
use std::os::unix::fs::PermissionsExt;
use std::path::{Path, PathBuf};
use std::process::Command;

use rustix::fs::statvfs;
use rustix::process::{Resource, getrlimit};
use telemime_endpoint::peers::{Peers, Role};
use telemime_endpoint::{Identity, admin};
use telemime_robot::servo::{Locked, Priority};

use super::Finding;

/// Linux' own buffers; a session needs no more, and a host that was set to less drops bursts.
const BUFFER_BYTES: u64 = 212_992;

/// Free disk below which a warning is due, and below which a record is soon cut short.
const DISK_WARN: u64 = 1 << 30;
const DISK_FAIL: u64 = 100 << 20;

/// The priority the servo takes unless told otherwise.
const USUAL_PRIORITY: u8 = 50;

pub(super) fn look(identity: Option<&Path>, peer_file: &Path) -> Vec<Finding> {
    let mut findings = vec![
        clock(),
        realtime(),
        buffers(Path::new("/proc/sys/net/core")),
        governor(Path::new("/sys/devices/system/cpu")),
    ];
    for (what, role) in [
        ("operator's key", Role::Operator),
        ("robot's key", Role::Robot),
    ] {
        let given = identity.filter(|_| role == Role::Operator);
        let file = given.map_or_else(|| admin::key_file(role), Path::to_owned);
        findings.push(key(what, &file));
    }
    findings.push(peers(peer_file));
    findings.push(disk(Path::new(".")));
    findings
}

fn clock() -> Finding {
    let what = "system clock";
    // The kernel's own word (adjtimex), which timedatectl passes on.
    let asked = Command::new("timedatectl")
        .args(["show", "--property=NTPSynchronized", "--value"])
        .output();
    let said = asked.ok().filter(|asked| asked.status.success());
    let said = said.map(|asked| String::from_utf8_lossy(&asked.stdout).trim().to_owned());
    match said.as_deref() {
        Some("yes") => Finding::ok(
            what,
            "kept right from outside; its error is for --clock-dispersion, if chrony or ptp4l states one",
        ),
        Some("no") => Finding::warn(
            what,
            "nothing keeps it right",
            "sessions do not need it (round trips are enough), but --clock-dispersion must not be given: start chrony, ptp4l or systemd-timesyncd",
        ),
        _ => Finding::warn(
            what,
            "nobody here says whether it is kept right",
            "leave --clock-dispersion out, unless you know of chrony or ptp4l that it is",
        ),
    }
}

fn realtime() -> Finding {
    let what = "real-time";
    let limit = |resource| {
        let limit = getrlimit(resource).current;
        limit.map_or_else(|| "unlimited".to_owned(), |limit| limit.to_string())
    };
    let limits = format!(
        "limits: priority {}, locked memory {} B",
        limit(Resource::Rtprio),
        limit(Resource::Memlock)
    );
    // On a thread of its own: the priority ends with it.
    let tried = Priority::new(USUAL_PRIORITY).ok().and_then(|priority| {
        let thread = std::thread::Builder::new().spawn(move || priority.take());
        thread.ok()?.join().ok()
    });
    let remedy = "for --realtime, let the robot have it: LimitRTPRIO=99 and LimitMEMLOCK=infinity in its unit (those of the \
                  package have them), or rtprio and memlock in /etc/security/limits.d";
    match tried {
        Some(granted) => match (granted.priority, granted.locked) {
            (Ok(priority), Ok(Locked::All)) => Finding::ok(
                what,
                format!("SCHED_FIFO {priority} and all memory locked are to be had"),
            ),
            (Ok(priority), Ok(Locked::Present)) => Finding::warn(
                what,
                format!("SCHED_FIFO {priority} is to be had, but memory under a limit; {limits}"),
                remedy,
            ),
            (Err(e), _) => Finding::warn(what, format!("no priority: {e}; {limits}"), remedy),
            (_, Err(e)) => Finding::warn(what, format!("no locked memory: {e}; {limits}"), remedy),
        },
        None => Finding::warn(what, "could not be tried", remedy),
    }
}

fn number(file: &Path) -> Option<u64> {
    fs::read_to_string(file).ok()?.trim().parse().ok()
}

fn buffers(net: &Path) -> Finding {
    let what = "socket buffers";
    let names = ["rmem_max", "wmem_max"];
    let sizes = names.map(|name| (name, number(&net.join(name))));
    let [(_, Some(read)), (_, Some(write))] = sizes else {
        return Finding::warn(
            what,
            "the kernel does not say how large they may be",
            "nothing, unless datagrams are lost on this host (`netstat -su`: receive buffer errors)",
        );
    };
    let found = format!("up to {read} B to receive and {write} B to send");
    if read.min(write) >= BUFFER_BYTES {
        return Finding::ok(what, found);
    }
    Finding::warn(
        what,
        found,
        format!(
            "sysctl -w net.core.rmem_max={BUFFER_BYTES} net.core.wmem_max={BUFFER_BYTES}, and in /etc/sysctl.d to keep it"
        ),
    )
}

fn governor(cpus: &Path) -> Finding {
    let what = "CPU frequency";
    let found = fs::read_dir(cpus).into_iter().flatten().flatten();
    let mut governors: Vec<String> = found
        .filter_map(|cpu| fs::read_to_string(cpu.path().join("cpufreq/scaling_governor")).ok())
        .map(|text| text.trim().to_owned())
        .collect();
    governors.sort();
    governors.dedup();
    if governors.is_empty() {
        return Finding::ok(what, "not scaled by this kernel");
    }
    let found = governors.join(", ");
    if governors == ["performance"] {
        return Finding::ok(what, found);
    }
    Finding::warn(
        what,
        found,
        "on a robot's host, cpupower frequency-set -g performance: waking a slow core costs the tick up to a millisecond",
    )
}

fn key(what: &'static str, file: &Path) -> Finding {
    let shown = file.display();
    if !file.exists() {
        return Finding::ok(what, format!("none at {shown}; made at the first start"));
    }
    match Identity::load_or_create(file) {
        Ok(identity) => {
            let mode = fs::metadata(file).map_or(0, |m| m.permissions().mode() & 0o777);
            let key = identity.fingerprint().short();
            Finding::ok(what, format!("{key} at {shown}, mode {mode:04o}"))
        }
        Err(e) => Finding::fail(
            what,
            e.to_string(),
            format!(
                "chmod 600 {shown} if it is yours; if it was ever readable by others, move it away and pair again"
            ),
        ),
    }
}

fn peers(file: &Path) -> Finding {
    let what = "peer file";
    let shown = file.display();
    match Peers::load(file) {
        Ok(peers) => {
            let count = |role| peers.keys(role, false).count();
            let revoked = peers.iter().filter(|peer| peer.revoked).count();
            let found = format!(
                "{} operators and {} robots trusted, {revoked} revoked in {shown}",
                count(Role::Operator),
                count(Role::Robot)
            );
            if count(Role::Operator) + count(Role::Robot) == 0 {
                let remedy = "run telemime pair HOST:PORT while the robot has a pairing window open, or give --peer";
                return Finding::warn(what, found, remedy);
            }
            Finding::ok(what, found)
        }
        Err(e) => Finding::fail(
            what,
            e.to_string(),
            "mend the line it names, or restore the file: daemons do not start with it",
        ),
    }
}

fn disk(folder: &Path) -> Finding {
    let what = "free disk";
    let shown: PathBuf = folder.canonicalize().unwrap_or_else(|_| folder.to_owned());
    let free = match statvfs(folder) {
        Ok(stat) => stat.f_bavail.saturating_mul(stat.f_frsize),
        Err(e) => {
            let found = format!("{}: {e}", shown.display());
            return Finding::warn(what, found, "choose a folder that is there for records");
        }
    };
    let found = format!("{:.1} GB in {}", free as f64 * 1e-9, shown.display());
    if free < DISK_FAIL {
        Finding::fail(what, found, "free some: records and skills are not written")
    } else if free < DISK_WARN {
        Finding::warn(
            what,
            found,
            "a tick-by-tick record takes about 1 GB an hour",
        )
    } else {
        Finding::ok(what, found)
    }
}

#[cfg(test)]
mod tests {
    use super::super::Verdict;
    use super::*;

    #[test]
    fn what_is_not_in_order_comes_with_a_remedy() {
        let dir = tempfile::tempdir().unwrap();
        let at = |name: &str| dir.path().join(name);
        fs::write(at("rmem_max"), "4096\n").unwrap();
        fs::write(at("wmem_max"), "212992\n").unwrap();
        let small = buffers(dir.path());
        assert_eq!(small.verdict, Verdict::Warn);
        assert!(small.remedy.unwrap().contains("sysctl"));
        fs::write(at("rmem_max"), "212992\n").unwrap();
        assert_eq!(buffers(dir.path()).verdict, Verdict::Ok);

        for (cpu, governor) in [("cpu0", "performance"), ("cpu1", "powersave")] {
            fs::create_dir_all(at(cpu).join("cpufreq")).unwrap();
            fs::write(at(cpu).join("cpufreq/scaling_governor"), governor).unwrap();
        }
        let scaled = governor(dir.path());
        assert_eq!(
            (scaled.verdict, scaled.found.as_str()),
            (Verdict::Warn, "performance, powersave")
        );

        assert_eq!(key("key", &at("none.key")).verdict, Verdict::Ok);
        assert!(!at("none.key").exists(), "nothing is changed");
        Identity::load_or_create(&at("a.key")).unwrap();
        assert_eq!(key("key", &at("a.key")).verdict, Verdict::Ok);
        fs::set_permissions(at("a.key"), fs::Permissions::from_mode(0o644)).unwrap();
        assert_eq!(key("key", &at("a.key")).verdict, Verdict::Fail);

        assert_eq!(peers(&at("peers")).verdict, Verdict::Warn);
        fs::write(at("peers"), "nonsense\n").unwrap();
        assert_eq!(peers(&at("peers")).verdict, Verdict::Fail);
        assert_eq!(disk(&at("nowhere")).verdict, Verdict::Warn);
    }
}
