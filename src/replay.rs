//! `telemime replay`: a black box's record, run again.

use std::io::{BufWriter, Write as _};
use std::path::PathBuf;

use anyhow::{Context, bail};
use serde::Serialize;
use telemime_robot::blackbox::{BlackBox, Replay, Row, replay};

/// Run a robot's black box again: compare every tick, and tell what happened.
///
/// The servo's own code decides once more on what it was told (orders, stops, joint states, time), and every decision is
/// compared with the recorded one to the bit. Exit code 1 if any differs.
#[derive(clap::Args, Debug)]
pub(crate) struct Args {
    /// A file that `telemime robot --black-box DIR` has written.
    #[arg(value_name = "FILE")]
    file: PathBuf,
    /// Write every tick, as replayed, to this CSV file.
    #[arg(long, value_name = "FILE")]
    csv: Option<PathBuf>,
    /// Print one JSON object instead.
    #[arg(long)]
    json: bool,
}

#[derive(Serialize)]
struct Told<'a> {
    why: &'a str,
    version: &'a str,
    arm: &'a str,
    driver: Option<&'a str>,
    identical: bool,
    #[serde(flatten)]
    replay: &'a Replay,
}

/// Runs the command.
pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let record = BlackBox::load(&args.file)?;
    let dof = record.header.home.len();
    let mut csv = match &args.csv {
        None => None,
        Some(path) => {
            let file = std::fs::File::create(path)
                .with_context(|| format!("cannot write {}", path.display()))?;
            let mut out = BufWriter::new(file);
            head(&mut out, dof).with_context(|| format!("cannot write {}", path.display()))?;
            Some(out)
        }
    };
    let shown = replay(&record, |row| match &mut csv {
        Some(out) => line(out, row, dof),
        None => Ok(()),
    })?;
    if let (Some(mut out), Some(path)) = (csv, &args.csv) {
        out.flush()
            .with_context(|| format!("cannot write {}", path.display()))?;
    }
    let header = &record.header;
    let identical = shown.difference.is_none();
    if args.json {
        say!(
            "{}",
            serde_json::to_string(&Told {
                why: &record.why,
                version: &header.version,
                arm: &header.urdf,
                driver: header.driver.as_deref(),
                identical,
                replay: &shown,
            })?
        );
    } else {
        say!(
            "{}: written for {}, by version {}; {}",
            args.file.display(),
            record.why,
            header.version,
            header.driver.as_ref().map_or_else(
                || format!("{}, simulated", header.urdf),
                |command| format!("{} behind `{command}`", header.urdf)
            )
        );
        for moment in &shown.moments {
            say!("{:9.3} s  {}", moment.t_s, moment.what);
        }
        let (ticks, orders, gaps) = (shown.ticks, shown.orders, shown.gaps);
        let missing = match gaps {
            0 => String::new(),
            n => format!("; ticks are missing in {n} places"),
        };
        say!(
            "{ticks} ticks, {:.1} s, {orders} orders{missing}",
            shown.span_s
        );
        if identical {
            say!("replayed: identical to the bit");
        }
    }
    if let Some(difference) = &shown.difference {
        let version = if header.version == env!("CARGO_PKG_VERSION") {
            String::new()
        } else {
            format!("; version {} wrote it", header.version)
        };
        bail!(
            "{} ticks differ, the first at {:.3} s (tick {}): {} was {}, replayed {}{version}",
            shown.differing,
            difference.t_s,
            difference.tick,
            difference.what,
            difference.recorded,
            difference.replayed
        );
    }
    Ok(())
}

fn head(out: &mut impl std::io::Write, dof: usize) -> std::io::Result<()> {
    write!(
        out,
        "tick,mono_ns,state,cause,engagement,orders,stop,age_s,clamps,moving,tip_x,tip_y,tip_z,target_x,target_y,target_z,reference_x,reference_y,reference_z,opening"
    )?;
    for name in ["q", "qd", "set_q", "set_qd", "set_qdd", "tau"] {
        (0..dof).try_for_each(|i| write!(out, ",{name}{i}"))?;
    }
    writeln!(out)
}

fn line(out: &mut impl std::io::Write, row: &Row, dof: usize) -> std::io::Result<()> {
    let r = &row.report;
    let stop = row.pulled.stop().or(row.pulled.hold());
    let stop = stop.map_or_else(String::new, |cause| format!("{cause:?}"));
    write!(
        out,
        "{},{},{:?},{:?},{},{},{stop},{},{},{}",
        r.tick,
        row.now.0,
        r.state,
        r.cause,
        r.engagement.number,
        row.orders,
        r.age_s,
        r.clamps,
        u8::from(r.moving)
    )?;
    let places = r.tip_m.iter().chain(&r.target_m).chain(&r.reference_m);
    places
        .chain(&[r.opening.unwrap_or(f64::NAN)])
        .try_for_each(|v| write!(out, ",{v}"))?;
    let set = &row.setpoint.reference;
    for joints in [
        &row.arm.q,
        &row.arm.qd,
        &set.q,
        &set.qd,
        &set.qdd,
        &row.setpoint.tau,
    ] {
        joints
            .iter()
            .take(dof)
            .try_for_each(|v| write!(out, ",{v}"))?;
    }
    writeln!(out)
}
