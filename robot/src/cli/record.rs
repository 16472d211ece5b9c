//! Every tick to a file, off the servo's thread; or a recording that viewers open.

use std::io::Write as _;
use std::path::{Path, PathBuf};
use std::sync::mpsc::{SyncSender, TrySendError, sync_channel};

use anyhow::{Context, bail};

use telemime_endpoint::recording;

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

/// A recording that viewers open, if that is what is wanted.
pub(super) fn scribe(path: Option<&Path>, rig: &Rig, log: &Log) -> anyhow::Result<Option<Scribe>> {
    let Some(path) = path.filter(|path| recording::is_named(path)) else {
        return Ok(None);
    };
    let log = log.clone();
    let say = move |outcome| log.recording(&outcome);
    Ok(Some(Scribe::start(path, rig, say)?))
}

/// Writes ticks to a CSV file from a thread of its own.
pub(super) struct TickRecorder {
    path: PathBuf,
    queue: SyncSender<Report>,
    thread: std::thread::JoinHandle<std::io::Result<()>>,
    lost: u64,
}

impl TickRecorder {
    fn start(path: &Path, dof: usize) -> anyhow::Result<Self> {
        let file = std::fs::File::create(path)
            .with_context(|| format!("cannot write {}", path.display()))?;
        let (queue, reports) = sync_channel::<Report>(QUEUE);
        let thread = std::thread::Builder::new().name("recorder".into()).spawn(move || {
            let mut out = std::io::BufWriter::new(file);
            write!(out, "tick,mono_ns,state,engagement,age_s,clamps,tip_x,tip_y,tip_z,target_x,target_y,target_z,tip_qw,tip_qx,tip_qy,tip_qz,opening,jerk")?;
            (0..dof).try_for_each(|i| write!(out, ",q{i}"))?;
            writeln!(out)?;
            for r in reports {
                write!(out, "{},{},{:?},{},{:.6},{}", r.tick, r.at.0, r.state, r.engagement.number, r.age_s, r.clamps)?;
                let q = &r.orientation;
                let turn = [q.w, q.i, q.j, q.k, r.opening, r.jerk_m_s3];
                r.tip_m.iter().chain(&r.target_m).chain(&turn).try_for_each(|v| write!(out, ",{v:.6}"))?;
                r.q.iter().take(dof).try_for_each(|v| write!(out, ",{v:.6}"))?;
                writeln!(out)?;
            }
            out.flush()
        })?;
        Ok(Self {
            path: path.to_owned(),
            queue,
            thread,
            lost: 0,
        })
    }

    pub(super) fn take(&mut self, report: &Report) {
        if let Err(TrySendError::Full(_)) = self.queue.try_send(*report) {
            self.lost += 1;
        }
    }

    pub(super) fn finish(self) -> anyhow::Result<()> {
        let Self {
            path,
            queue,
            thread,
            lost,
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
