//! Every tick to a file, off the servo's thread; or a recording that viewers open.

use std::fs::File;
use std::io::{ErrorKind, Write as _};
use std::net::SocketAddr;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};

use anyhow::{Context, bail};

use telemime_endpoint::recording::{self, To};

use super::report::Log;
use crate::recording::Scribe;
use crate::rig::Rig;
use crate::servo::Report;

/// Ticks on their way to the disk; a slow disk loses ticks, never the servo's time.
const QUEUE: usize = 8192;

/// Ticks as CSV, if that is what is wanted.
pub(super) fn ticks(path: Option<&Path>, rig: &Rig) -> anyhow::Result<Option<TickRecorder>> {
    let csv = path.filter(|path| !recording::is_named(path));
    csv.map(|path| TickRecorder::start(path, rig.arm.dof()))
        .transpose()
}

/// A recording that viewers open, or look at while it is made, if that is what is wanted.
pub(super) fn scribe(
    path: Option<&Path>,
    live: Option<SocketAddr>,
    rig: &Rig,
    log: &Log,
) -> anyhow::Result<Option<Scribe>> {
    let file = path.filter(|path| recording::is_named(path));
    let to = To { file, live };
    if to.is_nowhere() {
        return Ok(None);
    }
    let log = log.clone();
    let say = move |outcome| log.recording(&outcome);
    Ok(Some(Scribe::start(to, rig, say)?))
}

/// A new file at `path`; where one is, at the same with the next free number.
fn fresh(path: &Path) -> std::io::Result<(PathBuf, File)> {
    let mut fresh = path.to_owned();
    for n in 2.. {
        match File::create_new(&fresh) {
            Ok(file) => return Ok((fresh, file)),
            Err(e) if e.kind() == ErrorKind::AlreadyExists && path.file_stem().is_some() => {
                let mut name = path.file_stem().unwrap_or_default().to_owned();
                name.push(format!("-{n}"));
                if let Some(extension) = path.extension() {
                    name.push(".");
                    name.push(extension);
                }
                fresh.set_file_name(name);
            }
            Err(e) => return Err(e),
        }
    }
    Err(ErrorKind::AlreadyExists.into())
}

/// Writes ticks to a CSV file from a thread of its own.
pub(super) struct TickRecorder {
    path: PathBuf,
    queue: SyncSender<Report>,
    thread: std::thread::JoinHandle<std::io::Result<()>>,
    lost: u64,
    /// The thread has ended, and somebody was told.
    ended: bool,
}

impl TickRecorder {
    fn start(path: &Path, dof: usize) -> anyhow::Result<Self> {
        let (fresh, file) =
            fresh(path).with_context(|| format!("cannot write {}", path.display()))?;
        if fresh != path {
            telemime_endpoint::logs::note(&format!(
                "{} is there already; the ticks go to {}",
                path.display(),
                fresh.display()
            ));
        }
        Self::on(fresh, file, dof)
    }

    fn on(path: PathBuf, file: File, dof: usize) -> anyhow::Result<Self> {
        let (queue, reports) = sync_channel::<Report>(QUEUE);
        let thread = std::thread::Builder::new().name("recorder".into()).spawn(move || {
            let mut out = std::io::BufWriter::new(file);
            write!(out, "tick,mono_ns,state,engagement,age_s,clamps,tip_x,tip_y,tip_z,target_x,target_y,target_z,tip_qw,tip_qx,tip_qy,tip_qz,opening,jerk")?;
            (0..dof).try_for_each(|i| write!(out, ",q{i}"))?;
            writeln!(out)?;
            for r in reports {
                write!(out, "{},{},{:?},{},{:.6},{}", r.tick, r.at.0, r.state, r.engagement.number, r.age_s, r.clamps)?;
                let q = &r.orientation;
                let turn = [q.w, q.i, q.j, q.k, r.opening.unwrap_or(f64::NAN), r.jerk_m_s3];
                r.tip_m.iter().chain(&r.target_m).chain(&turn).try_for_each(|v| write!(out, ",{v:.6}"))?;
                r.q.iter().take(dof).try_for_each(|v| write!(out, ",{v:.6}"))?;
                writeln!(out)?;
            }
            out.flush()
        })?;
        Ok(Self {
            path,
            queue,
            thread,
            lost: 0,
            ended: false,
        })
    }

    pub(super) fn take(&mut self, report: &Report) {
        match self.queue.try_send(*report) {
            Ok(()) => {}
            Err(TrySendError::Full(_)) => self.lost += 1,
            Err(TrySendError::Disconnected(_)) => {
                if !std::mem::replace(&mut self.ended, true) {
                    telemime_endpoint::logs::note(&format!(
                        "{} cannot be written any more, and no tick from now on is in it; the reason follows when the robot ends",
                        self.path.display()
                    ));
                }
            }
        }
    }

    pub(super) fn finish(self) -> anyhow::Result<()> {
        let Self {
            path,
            queue,
            thread,
            lost,
            ended: _,
        } = self;
        drop(queue);
        match thread.join() {
            Ok(written) => written.with_context(|| format!("cannot write {}", path.display()))?,
            Err(_) => bail!("the recorder of {} failed", path.display()),
        }
        if lost > 0 {
            telemime_endpoint::logs::note(&format!(
                "{lost} ticks are missing in {}: the disk was too slow",
                path.display()
            ));
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_disk_that_is_full_is_noticed_when_it_is_and_told_at_the_end() {
        let full = File::options().write(true).open("/dev/full").unwrap();
        let mut recorder = TickRecorder::on("ticks.csv".into(), full, 7).unwrap();
        let rig = Rig::load(&crate::rig::RigOptions::default()).unwrap();
        let (rings, _handle) = crate::servo::rings();
        let report = rig.servo(rings).tick(telemime_endpoint::Mono(0));
        // Until its thread has found out.
        while !recorder.ended {
            recorder.take(&report);
            std::thread::yield_now();
        }
        let lost = recorder.lost;
        recorder.take(&report);
        assert_eq!(recorder.lost, lost, "not for being slow");
        let told = format!("{:#}", recorder.finish().unwrap_err());
        assert!(told.contains("cannot write ticks.csv"), "{told}");
    }

    #[test]
    fn an_earlier_recording_is_not_written_over() {
        let dir = tempfile::tempdir().unwrap();
        for name in ["ticks.csv", "ticks", "two.dots.csv"] {
            let path = dir.path().join(name);
            std::fs::write(&path, "an hour of ticks").unwrap();
            let again: Vec<_> = (0..2).map(|_| fresh(&path).unwrap().0).collect();
            assert!(again[0] != path && again[0] != again[1], "{again:?}");
            assert_eq!(again[1].extension(), path.extension());
            assert_eq!(std::fs::read_to_string(&path).unwrap(), "an hour of ticks");
        }
        assert_eq!(
            fresh(&dir.path().join("new.csv")).unwrap().0,
            dir.path().join("new.csv")
        );
        assert!(
            fresh(&dir.path().join("ticks-2.csv"))
                .unwrap()
                .0
                .ends_with("ticks-2-2.csv")
        );
        let error = fresh(&dir.path().join("gone").join("ticks.csv")).unwrap_err();
        assert_eq!(error.kind(), ErrorKind::NotFound);
    }
}
