//! The demo's result, for people and as the one JSON object that `docs/experiments.md` describes.

use std::path::PathBuf;

use anyhow::Context;
use serde::Serialize;
use telemime_operator::cli::Event as Operator;
use telemime_robot::cli::Event as Robot;
use telemime_sim::link::LinkConfig;

use super::judge::Verdict;
use super::processes::Run;
use super::{Args, Material};

/// Bytes of a raw sample: four f32 (four more for an orientation) and the headers of IP and UDP.
const RAW_SAMPLE: u64 = 4 * 4 + 28;
const RAW_TURN: u64 = 4 * 4;

/// Kept stable: fields are added, not changed.
#[derive(Debug, Serialize)]
struct Result {
    what: String,
    arm: String,
    rmse_delayed_m: f64,
    rmse_delayed_same_arm_m: f64,
    rmse_floor_m: f64,
    rmse_predicted_m: f64,
    fraction_hidden: Option<f64>,
    turn: Option<Turn>,
    lags_at_edge: Vec<&'static str>,
    lag_delayed_ms: f64,
    lag_delayed_same_arm_ms: f64,
    lag_floor_ms: f64,
    lag_predicted_ms: f64,
    scale: f64,
    jerk_m_s3: f64,
    jerk_ratio: Option<f64>,
    glitches: u32,
    clamps: u32,
    coasted: u32,
    bytes_on_wire: u64,
    bytes_raw: u64,
    bytes_session: Session,
    messages: u32,
    checkpoints: u32,
    samples: u32,
    samples_at_rest: u32,
    path_bound_m: f64,
    path_error_m: f64,
    path_samples: usize,
    link_delay_ms: f64,
    link_jitter_ms: f64,
    /// Null where losses are correlated in netem's way.
    link_loss: Option<f64>,
    link_up: LinkConfig,
    link_down: LinkConfig,
    #[serde(skip)]
    link: String,
    clock_bound_ms: Option<f64>,
    judged_s: f64,
    tick_mean_us: f64,
    tick_p99_us: f64,
    overruns: u32,
    ticks_lost: u64,
}

/// The orientation's errors, rad RMS.
#[derive(Debug, Clone, Copy, Serialize)]
struct Turn {
    rmse_delayed_rad: f64,
    rmse_delayed_same_arm_rad: f64,
    rmse_floor_rad: f64,
    rmse_predicted_rad: f64,
}

#[derive(Debug, Clone, Copy, Serialize)]
struct Session {
    operator_to_robot: u64,
    robot_to_operator: u64,
}

pub(super) fn print(
    args: &Args,
    material: &Material,
    run: &Run,
    verdict: &Verdict,
    figures: &[PathBuf],
) -> anyhow::Result<()> {
    let result = gather(args, material, run, verdict)?;
    deliver(args, table(&result), &result, figures)
}

/// The text for people and, with `--json`, the object for machines.
pub(super) fn deliver(
    args: &Args,
    mut text: String,
    result: &impl Serialize,
    figures: &[PathBuf],
) -> anyhow::Result<()> {
    for figure in figures {
        text.push_str(&format!("figure        {}\n", figure.display()));
    }
    if args.json {
        eprint!("{text}");
        say!("{}", serde_json::to_string(result)?);
    } else {
        say!("{}", text.trim_end());
    }
    Ok(())
}

/// Mean and 99th percentile of a servo tick, µs, and late ticks.
pub(super) fn servo(run: &Run) -> (f64, f64, u32) {
    let found = run.robot.iter().find_map(|e| match e {
        Robot::Servo {
            mean_ns,
            p99_ns,
            overruns,
            ..
        } => Some((
            f64::from(*mean_ns) * 1e-3,
            f64::from(*p99_ns) * 1e-3,
            *overruns,
        )),
        _ => None,
    });
    found.unwrap_or_default()
}

/// The arm's name.
pub(super) fn arm(run: &Run) -> String {
    let name = run.robot.iter().find_map(|e| {
        if let Robot::Listening { arm, .. } = e {
            Some(arm)
        } else {
            None
        }
    });
    name.cloned().unwrap_or_default()
}

fn gather(
    args: &Args,
    material: &Material,
    run: &Run,
    verdict: &Verdict,
) -> anyhow::Result<Result> {
    let done = run
        .operator
        .iter()
        .find(|e| matches!(e, Operator::Done { .. }));
    let Some(Operator::Done {
        samples,
        samples_at_rest,
        glitches,
        messages,
        knots,
        bytes_on_wire,
        bytes_session_up,
        bytes_session_down,
        ..
    }) = done
    else {
        anyhow::bail!("the operator gave no result");
    };
    let path_bound_m = run.operator.iter().find_map(|e| match e {
        Operator::Mapping { path_bound_m, .. } => Some(*path_bound_m),
        _ => None,
    });
    let clock_bound_ms = run.robot.iter().find_map(|e| match e {
        Robot::Disconnected { clock_bound_s, .. } => clock_bound_s.map(|s| s * 1e3),
        _ => None,
    });
    let (tick_mean_us, tick_p99_us, overruns) = servo(run);
    Ok(Result {
        what: material.what.clone(),
        arm: arm(run),
        rmse_delayed_m: verdict.delayed.rmse_m,
        rmse_delayed_same_arm_m: verdict.delayed_arm.rmse_m,
        rmse_floor_m: verdict.floor.rmse_m,
        rmse_predicted_m: verdict.predicted.rmse_m,
        fraction_hidden: verdict.fraction_hidden(),
        turn: verdict.turn.as_ref().map(|turn| Turn {
            rmse_delayed_rad: turn.delayed_rad,
            rmse_delayed_same_arm_rad: turn.delayed_arm_rad,
            rmse_floor_rad: turn.floor_rad,
            rmse_predicted_rad: turn.predicted_rad,
        }),
        lags_at_edge: verdict.lags_at_edge(),
        lag_delayed_ms: verdict.delayed.lag_s * 1e3,
        lag_delayed_same_arm_ms: verdict.delayed_arm.lag_s * 1e3,
        lag_floor_ms: verdict.floor.lag_s * 1e3,
        lag_predicted_ms: verdict.predicted.lag_s * 1e3,
        scale: verdict.mapping.scale,
        jerk_m_s3: verdict.jerk_m_s3,
        jerk_ratio: verdict.jerk_ratio,
        glitches: *glitches,
        clamps: verdict.clamps,
        coasted: verdict.coasted,
        bytes_on_wire: *bytes_on_wire,
        bytes_raw: (RAW_SAMPLE + u64::from(verdict.turn.is_some()) * RAW_TURN)
            * u64::from(*samples),
        bytes_session: Session {
            operator_to_robot: *bytes_session_up,
            robot_to_operator: *bytes_session_down,
        },
        messages: *messages,
        checkpoints: *knots,
        samples: *samples,
        samples_at_rest: *samples_at_rest,
        path_bound_m: path_bound_m.context("the operator never said how it maps")?,
        path_error_m: verdict.path_error_m,
        path_samples: verdict.path_samples,
        link_delay_ms: args.link.up().delay_s * 1e3,
        link_jitter_ms: args.link.up().jitter_s * 1e3,
        link_loss: args.link.up().loss.share(),
        link_up: args.link.up(),
        link_down: args.link.down(),
        link: args.link.describe(),
        clock_bound_ms,
        judged_s: verdict.grid_s.len() as f64 * 1e-3,
        tick_mean_us,
        tick_p99_us,
        overruns,
        ticks_lost: verdict.ticks_lost,
    })
}

fn table(r: &Result) -> String {
    let mm = |m: f64| format!("{:6.1} mm", m * 1e3);
    let ms = |ms: f64| format!("{ms:5.0} ms");
    let hidden = r.fraction_hidden.map_or_else(
        || "the delay costs too little to tell".to_owned(),
        |share| format!("{:.0} % of the delay's cost hidden", share * 1e2),
    );
    let turn = r.turn.map_or_else(String::new, |t| {
        let degrees = |rad: f64| format!("{:.2}°", rad.to_degrees());
        format!(
            "orientation   RMS: delayed {}, through the arm {}; predicted {}; floor {}\n",
            degrees(t.rmse_delayed_rad),
            degrees(t.rmse_delayed_same_arm_rad),
            degrees(t.rmse_predicted_rad),
            degrees(t.rmse_floor_rad)
        )
    });
    let clock = r.clock_bound_ms.map_or_else(String::new, |ms| {
        format!(", session clock known to ±{ms:.0} ms")
    });
    format!(
        "\n{}\n{} at scale {:.3}; {}; judged over {:.1} s\n\n\
         hand against tip, in hand metres      RMS error    lag\n\
         as sent, delayed, ideal tip          {}   {}\n\
         as sent, delayed, through the arm    {}   {}\n\
         predicted                            {}   {}   {}\n\
         floor: perfect knowledge, same arm   {}   {}\n\n\
         {turn}smoothness    RMS jerk {:.0} m/s³ at the tip{}\n\
         on the wire   {} B of motion in {} messages; raw streaming {} B; ratio {:.2}\n\
         path          {} checkpoints for {} samples; within {} of the hand ({} promised)\n\
         session       {} B up, {} B down besides (keys, model, acknowledgements, telemetry){clock}\n\
         servo         {:.1} µs a tick, {:.1} µs p99, {} late, {} not recorded; a limit acted on {} ticks; coasted {} times\n",
        r.what,
        r.arm,
        r.scale,
        r.link,
        r.judged_s,
        mm(r.rmse_delayed_m),
        ms(r.lag_delayed_ms),
        mm(r.rmse_delayed_same_arm_m),
        ms(r.lag_delayed_same_arm_ms),
        mm(r.rmse_predicted_m),
        ms(r.lag_predicted_ms),
        hidden,
        mm(r.rmse_floor_m),
        ms(r.lag_floor_ms),
        r.jerk_m_s3,
        r.jerk_ratio.map_or_else(String::new, |ratio| format!(
            ", {ratio:.2} times that of the scaled hand"
        )),
        r.bytes_on_wire,
        r.messages,
        r.bytes_raw,
        r.bytes_on_wire as f64 / r.bytes_raw as f64,
        r.checkpoints,
        r.samples,
        mm(r.path_error_m).trim(),
        mm(r.path_bound_m).trim(),
        r.bytes_session.operator_to_robot,
        r.bytes_session.robot_to_operator,
        r.tick_mean_us,
        r.tick_p99_us,
        r.overruns,
        r.ticks_lost,
        r.clamps,
        r.coasted,
    )
}
