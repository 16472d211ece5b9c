//! `telemime arm check`: what a description gives, before anything is driven with it.

use std::fmt::Write as _;
use std::path::PathBuf;
use std::sync::Arc;

use anyhow::Context;
use clap::Subcommand;
use serde::Serialize;
use telemime_robot::cli::parse_fixed;
use telemime_robot::control::{
    CloseAtStart, ControlConfig, ControlError, Controller, home_posture, workspace_radius,
};
use telemime_sim::arm::{
    ArmModel, CapsuleSource, Joint, JointKind, Joints, LoadOptions, Notice, Payload, Unguarded,
    default_urdf,
};

/// Look at an arm's description.
#[derive(clap::Args, Debug)]
pub(crate) struct Args {
    #[command(subcommand)]
    command: Command,
}

#[derive(Subcommand, Debug)]
enum Command {
    /// Check a URDF: its chain, limits, masses, hulls, where it would start and how fast its tip may move, and what is wrong with it.
    ///
    /// The exit code is 0 if the arm can be driven, and 1 with one line on stderr if not.
    Check(CheckArgs),
}

#[derive(clap::Args, Debug)]
struct CheckArgs {
    /// The description, expanded from xacro [default: the built-in arm].
    #[arg(value_name = "URDF")]
    urdf: Option<PathBuf>,
    /// The link that follows the hand [default: tool0, tcp, or the deepest link].
    #[arg(long, value_name = "LINK")]
    tip: Option<String>,
    /// Fix a joint that is not on the way to the tip (a finger); may be repeated.
    #[arg(long, value_name = "JOINT=VALUE", value_parser = parse_fixed)]
    fixed: Vec<(String, f64)>,
    /// What the tip carries: KG, KG@X,Y,Z (centre, m from the tip) or KG@X,Y,Z@IXX,IYY,IZZ (moments, kg·m²).
    #[arg(long, value_name = "KG[@X,Y,Z]")]
    payload: Option<Payload>,
    /// Start posture, one value per joint, rad or m [default: searched].
    #[arg(
        long,
        value_name = "Q1,Q2,…",
        value_delimiter = ',',
        allow_negative_numbers = true
    )]
    start: Option<Vec<f64>>,
    /// Print one JSON object instead of tables.
    #[arg(long)]
    json: bool,
}

/// All that is found out; lengths in m, angles in rad, base axes unless said otherwise. Limits that are not stated are `null`.
#[derive(Serialize)]
struct Report {
    name: String,
    tip: String,
    joints: Vec<JointRow>,
    moving_mass_kg: f64,
    payload_kg: f64,
    chain_m: f64,
    reach_m: f64,
    capsules: Vec<CapsuleRow>,
    guarded_pairs: usize,
    unguarded_pairs: Vec<UnguardedRow>,
    start: Start,
    drive: Result<Drive, String>,
    notes: Vec<String>,
    warnings: Vec<String>,
}

#[derive(Serialize)]
struct JointRow {
    name: String,
    kind: &'static str,
    lower: Option<f64>,
    upper: Option<f64>,
    speed: Option<f64>,
    effort: Option<f64>,
    damping: f64,
    friction: f64,
    mass_kg: f64,
    centre_m: [f64; 3],
}

#[derive(Serialize)]
struct CapsuleRow {
    body: usize,
    link: String,
    length_m: f64,
    radius_m: f64,
    from: &'static str,
}

#[derive(Serialize)]
struct UnguardedRow {
    links: [String; 2],
    why: String,
}

#[derive(Serialize)]
struct Start {
    q: Vec<f64>,
    searched: bool,
    tip_m: [f64; 3],
    nearest_m: Option<f64>,
    nearest: Option<[String; 2]>,
}

#[derive(Serialize)]
struct Drive {
    speed_m_s: f64,
    acceleration_m_s2: f64,
    jerk_m_s3: f64,
    turn_rad_s: f64,
    turn_rad_s2: f64,
    radius_m: f64,
}

pub(crate) fn run(args: &Args) -> anyhow::Result<()> {
    let Command::Check(args) = &args.command;
    let (name, text) = match &args.urdf {
        None => ("the built-in arm".to_owned(), default_urdf().to_owned()),
        Some(path) => {
            let name = path.display().to_string();
            let text =
                std::fs::read_to_string(path).with_context(|| format!("cannot read {name}"))?;
            (name, text)
        }
    };
    let load = LoadOptions {
        tip: args.tip.clone(),
        fixed: args.fixed.iter().cloned().collect(),
        payload: args.payload,
    };
    let arm = ArmModel::from_urdf(&text, &load).with_context(|| name.clone())?;
    let given = args.start.as_deref().map(|q| {
        arm.posture(q).with_context(|| {
            let dof = arm.dof();
            format!(
                "--start has {} values for {dof} joints, or one outside its limits",
                q.len()
            )
        })
    });
    let start = given.transpose()?;
    let report = look(arm, start, args.payload);
    if args.json {
        say!("{}", serde_json::to_string(&report)?);
    } else {
        say!("{}", told(&report).trim_end());
    }
    match report.drive {
        Ok(_) => Ok(()),
        Err(why) => Err(anyhow::anyhow!("{name} cannot be driven: {why}")),
    }
}

fn look(arm: ArmModel, given: Option<Joints>, payload: Option<Payload>) -> Report {
    let arm = Arc::new(arm);
    let start = given.unwrap_or_else(|| home_posture(&arm));
    let config = ControlConfig::default();
    let mut hulls = config.barrier.hulls(&arm, &start);
    let mut kinematics = telemime_sim::arm::Kinematics::new();
    kinematics.update(&arm, &start);
    hulls.place(&kinematics);
    let nearest = hulls.nearest();
    let links = |(a, b): (usize, usize)| [a, b].map(|i| arm.capsules()[i].link.clone());
    let (mut notes, mut warnings) = (Vec::new(), Vec::new());
    for notice in arm.notices() {
        match notice {
            Notice::TipChosen { .. } | Notice::JointFixed { .. } => notes.push(notice.to_string()),
            _ => warnings.push(notice.to_string()),
        }
    }
    let close = CloseAtStart::among(&arm, &hulls);
    warnings.extend(close.iter().map(ToString::to_string));
    let drive = drive(&arm, &config, &start);
    Report {
        name: arm.name().to_owned(),
        tip: arm.tip().to_owned(),
        joints: arm.joints().iter().map(row).collect(),
        moving_mass_kg: arm.moving_mass_kg(),
        payload_kg: payload.map_or(0.0, |p| p.body().mass_kg),
        chain_m: arm.chain_length_m(),
        reach_m: arm.sampled_reach_m(),
        capsules: arm
            .capsules()
            .iter()
            .map(|c| CapsuleRow {
                body: c.body,
                link: c.link.clone(),
                length_m: (c.b - c.a).norm(),
                radius_m: c.radius_m,
                from: match c.source {
                    CapsuleSource::Geometry => "shape",
                    CapsuleSource::Derived => "derived",
                },
            })
            .collect(),
        guarded_pairs: hulls.pairs().len(),
        unguarded_pairs: hulls
            .unguarded()
            .iter()
            .map(|(pair, why)| UnguardedRow {
                links: links(*pair),
                why: match why {
                    Unguarded::AlwaysClose { share } => {
                        format!("too close in {:.0} % of all postures", share * 100.0)
                    }
                    Unguarded::AtStart { .. } => "too close at the start".to_owned(),
                },
            })
            .collect(),
        start: Start {
            q: start.as_slice()[..arm.dof()].to_vec(),
            searched: given.is_none(),
            tip_m: kinematics.tip().into(),
            nearest_m: nearest.map(|n| n.proximity.distance_m),
            nearest: nearest.map(|n| links(n.pair)),
        },
        drive: drive.map_err(|e| e.to_string()),
        notes,
        warnings,
    }
}

fn drive(
    arm: &Arc<ArmModel>,
    config: &ControlConfig,
    start: &Joints,
) -> Result<Drive, ControlError> {
    let controller = Controller::new(Arc::clone(arm), config, start)?;
    let (limits, turn) = (controller.limits(), controller.turn_limits());
    Ok(Drive {
        speed_m_s: limits.v_max,
        acceleration_m_s2: limits.a_max,
        jerk_m_s3: limits.j_max,
        turn_rad_s: turn.v_max,
        turn_rad_s2: turn.a_max,
        radius_m: workspace_radius(arm, start),
    })
}

fn row(joint: &Joint) -> JointRow {
    let stated = |value: f64| value.is_finite().then_some(value);
    JointRow {
        name: joint.name.clone(),
        kind: match joint.kind {
            JointKind::Prismatic => "prismatic",
            JointKind::Revolute if joint.is_limited() => "revolute",
            JointKind::Revolute => "continuous",
        },
        lower: stated(joint.lower),
        upper: stated(joint.upper),
        speed: stated(joint.velocity),
        effort: stated(joint.effort),
        damping: joint.damping,
        friction: joint.friction,
        mass_kg: joint.body.mass_kg,
        centre_m: joint.body.com_m.into(),
    }
}

/// Without the minus sign of what would be printed as zero.
fn plain(value: f64) -> f64 {
    if value.abs() < 5e-4 { 0.0 } else { value }
}

/// The report for people.
fn told(report: &Report) -> String {
    let mut out = String::new();
    // Writing to a String cannot fail.
    let _ = write_report(&mut out, report);
    out
}

fn write_report(out: &mut String, r: &Report) -> std::fmt::Result {
    let carried = match r.payload_kg {
        0.0 => String::new(),
        kg => format!(" of which {kg} kg are payload,"),
    };
    writeln!(
        out,
        "{}: {} joints to `{}`, {:.2} kg move,{carried} chain {:.3} m, reach {:.3} m from the first joint\n",
        r.name,
        r.joints.len(),
        r.tip,
        r.moving_mass_kg,
        r.chain_m,
        r.reach_m
    )?;
    let wide = r.joints.iter().map(|j| j.name.chars().count()).max();
    let wide = wide.unwrap_or(0).max("joint".len());
    writeln!(
        out,
        "{:wide$}  {:10}  {:>8} {:>8}  {:>6}  {:>7}  {:>7}  {:>8}  {:>7}  centre (joint frame), m",
        "joint", "kind", "from", "to", "speed", "effort", "damping", "friction", "mass kg"
    )?;
    let number = |value: Option<f64>, digits: usize| {
        value.map_or_else(|| "–".to_owned(), |v| format!("{v:.digits$}"))
    };
    for j in &r.joints {
        let [x, y, z] = j.centre_m.map(plain);
        writeln!(
            out,
            "{:wide$}  {:10}  {:>8} {:>8}  {:>6}  {:>7}  {:>7.3}  {:>8.3}  {:>7.3}  {x:.3} {y:.3} {z:.3}",
            j.name,
            j.kind,
            number(j.lower, 3),
            number(j.upper, 3),
            number(j.speed, 2),
            number(j.effort, 1),
            j.damping,
            j.friction,
            j.mass_kg
        )?;
    }
    writeln!(out, "(rad, rad/s, N·m; of slides m, m/s, N)\n")?;
    let wide = r.capsules.iter().map(|c| c.link.chars().count()).max();
    let wide = wide.unwrap_or(0).max("hull of".len());
    writeln!(out, "{:wide$}  length m  radius m  from", "hull of")?;
    for c in &r.capsules {
        writeln!(
            out,
            "{:wide$}  {:8.3}  {:8.3}  {}",
            c.link, c.length_m, c.radius_m, c.from
        )?;
    }
    writeln!(
        out,
        "{} pairs are kept apart; not those that share a joint{}",
        r.guarded_pairs,
        if r.unguarded_pairs.is_empty() {
            ""
        } else {
            ", nor:"
        }
    )?;
    for pair in &r.unguarded_pairs {
        let [a, b] = &pair.links;
        writeln!(out, "  {a} and {b}: {}", pair.why)?;
    }
    let q: Vec<String> = r
        .start
        .q
        .iter()
        .map(|q| format!("{:.3}", plain(*q)))
        .collect();
    let [x, y, z] = r.start.tip_m.map(plain);
    writeln!(
        out,
        "\nstart ({}): {}\n  tip at {x:.3} {y:.3} {z:.3} m",
        if r.start.searched {
            "searched"
        } else {
            "given"
        },
        q.join(" ")
    )?;
    if let (Some(distance_m), Some([a, b])) = (r.start.nearest_m, &r.start.nearest) {
        writeln!(
            out,
            "  nearest hulls: {a} and {b}, {:.0} mm",
            distance_m * 1e3
        )?;
    }
    match &r.drive {
        Ok(d) => writeln!(
            out,
            "  tip limits {:.2} m/s, {:.1} m/s², {:.0} m/s³; turning {:.2} rad/s, {:.1} rad/s²\n  workspace: {:.3} m around the tip",
            d.speed_m_s, d.acceleration_m_s2, d.jerk_m_s3, d.turn_rad_s, d.turn_rad_s2, d.radius_m
        )?,
        Err(why) => writeln!(out, "  cannot be driven from there: {why}")?,
    }
    if !(r.notes.is_empty() && r.warnings.is_empty()) {
        writeln!(out)?;
    }
    for note in &r.notes {
        writeln!(out, "note: {note}")?;
    }
    for warning in &r.warnings {
        writeln!(out, "warning: {warning}")?;
    }
    Ok(())
}
