//! This very program as one of the daemons: started, listened to, ended.

use std::net::SocketAddr;
use std::path::Path;
use std::process::Stdio;
use std::time::Duration;

use anyhow::{Context, bail};
use serde::de::DeserializeOwned;
use telemime_robot::cli::Event as Robot;
use tokio::io::{AsyncBufReadExt, BufReader, Lines};
use tokio::process::{Child, ChildStdout, Command};
use tokio::time::timeout;

/// A process that is asked to end gets this long before it is killed.
const GRACE: Duration = Duration::from_secs(5);

/// A robot gets this long until it listens: an arm's start posture may have to be searched.
const START: Duration = Duration::from_secs(60);

/// What the daemons' settings in the environment begin with.
const PREFIXES: [&str; 2] = ["TELEMIME_ROBOT_", "TELEMIME_OPERATOR_"];

/// A daemon that runs.
pub(crate) struct Process {
    name: &'static str,
    child: Child,
    lines: Lines<BufReader<ChildStdout>>,
}

impl Process {
    /// Starts this very program as one of the daemons, `name`. It ends when we do: its stdin is ours.
    pub(crate) fn start(name: &'static str, args: &[String]) -> anyhow::Result<Self> {
        Self::start_by(&[], name, args)
    }

    /// The same by way of another program: `by` are its name and arguments, this program's follow.
    pub(crate) fn start_by(
        by: &[String],
        name: &'static str,
        args: &[String],
    ) -> anyhow::Result<Self> {
        let program = std::env::current_exe().context("where is this program?")?;
        let mut command = match by.split_first() {
            None => Command::new(program),
            Some((first, rest)) => {
                let mut command = Command::new(first);
                command.args(rest).arg(program);
                command
            }
        };
        // What it is told here is all it is told.
        let settings = std::env::vars_os().map(|(name, _)| name).filter(|name| {
            let name = name.to_string_lossy();
            PREFIXES.iter().any(|prefix| name.starts_with(prefix))
        });
        settings.for_each(|name| {
            command.env_remove(name);
        });
        let mut child = command
            .arg(name)
            .args(args)
            .args(["--json", "--follow-stdin"])
            .stdin(Stdio::piped())
            .stdout(Stdio::piped())
            .kill_on_drop(true)
            .spawn()
            .with_context(|| format!("cannot start the {name}"))?;
        let stdout = child.stdout.take().context("no pipe")?;
        Ok(Self {
            name,
            child,
            lines: BufReader::new(stdout).lines(),
        })
    }

    /// Where to read what CPU time it has taken.
    pub(crate) fn cpu_time(&self) -> CpuTime {
        CpuTime(self.child.id())
    }

    /// The next event; `None` once the process has closed its stdout.
    pub(crate) async fn next<E: DeserializeOwned>(&mut self) -> anyhow::Result<Option<E>> {
        let Some(line) = self.lines.next_line().await? else {
            return Ok(None);
        };
        let event =
            serde_json::from_str(&line).with_context(|| format!("{} says: {line}", self.name))?;
        Ok(Some(event))
    }

    /// Closes its stdin, which ends it, and collects what it still says.
    pub(crate) async fn finish<E: DeserializeOwned>(
        mut self,
        events: &mut Vec<E>,
    ) -> anyhow::Result<()> {
        drop(self.child.stdin.take());
        let rest = async {
            while let Some(event) = self.next().await? {
                events.push(event);
            }
            anyhow::Ok(self.child.wait().await?)
        };
        match timeout(GRACE, rest).await {
            Ok(done) => done.map(|_| ()),
            Err(_) => {
                self.child.kill().await?;
                bail!(
                    "the {} did not end when asked to, and was killed",
                    self.name
                )
            }
        }
    }
}

/// The CPU time of a process and all its threads, user's and kernel's, as proc(5) counts it: in hundredths of a second.
pub(crate) struct CpuTime(Option<u32>);

impl CpuTime {
    /// Up to now; `None` where the host does not say. A process that has ended says it until it has been waited for.
    pub(crate) fn read(&self) -> Option<Duration> {
        let stat = std::fs::read_to_string(format!("/proc/{}/stat", self.0?)).ok()?;
        let ticks = cpu_ticks(&stat)?;
        let per_s = rustix::param::clock_ticks_per_second();
        Some(Duration::from_secs_f64(ticks as f64 / per_s as f64))
    }
}

/// `utime` and `stime`, fields 14 and 15. The second field, a name, may hold blanks and parentheses.
fn cpu_ticks(stat: &str) -> Option<u64> {
    let (_, rest) = stat.rsplit_once(')')?;
    let mut fields = rest.split_ascii_whitespace().skip(11);
    let mut next = || fields.next()?.parse::<u64>().ok();
    Some(next()? + next()?)
}

/// A path as an argument.
pub(crate) fn text(path: &Path) -> String {
    path.to_string_lossy().into_owned()
}

/// Flag and value, if there is a value.
pub(crate) fn flag<T: ToString>(name: &str, value: Option<T>) -> Vec<String> {
    value.map_or_else(Vec::new, |v| vec![name.to_owned(), v.to_string()])
}

/// Where the robot listens, which is the first it says; kept in `events`.
pub(crate) async fn listening(
    robot: &mut Process,
    events: &mut Vec<Robot>,
) -> anyhow::Result<SocketAddr> {
    let first = timeout(START, robot.next())
        .await
        .context("the robot does not start")??;
    let Some(event) = first else {
        bail!("the robot did not start; it says why above")
    };
    events.push(event);
    match events.last() {
        Some(Robot::Listening { addr, .. }) => Ok(*addr),
        other => bail!("the robot begins with {other:?}"),
    }
}

/// Keeps what the robot says. Ends only if the robot does, which it should not.
pub(crate) async fn watch_robot(
    robot: &mut Process,
    events: &mut Vec<Robot>,
) -> anyhow::Result<()> {
    while let Some(event) = robot.next().await? {
        events.push(event);
    }
    bail!("the robot ended before the operator; it says why above")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn cpu_time_is_told_whatever_the_process_is_called() {
        let stat = "7 (a) b (c)) S 1 7 7 0 -1 4194560 900 0 0 0 123 45 6 7 20 0 3 0 99 1000 200";
        assert_eq!(cpu_ticks(stat), Some(168));
        assert_eq!(cpu_ticks("7 (a) S 1"), None);
        let own = CpuTime(Some(std::process::id()));
        let before = own.read().unwrap();
        let mut spun = 0_u64;
        while own.read().unwrap() == before {
            spun = spun.wrapping_mul(3).wrapping_add(1);
        }
        assert!(own.read().unwrap() > before);
        assert_eq!(CpuTime(None).read(), None);
    }
}
