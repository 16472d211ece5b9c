//! Flags of a tracked hand.

use std::net::IpAddr;
use std::path::PathBuf;

use anyhow::bail;
use nalgebra::UnitQuaternion;
use serde::Deserialize;

use super::report::{Event, Log};
use crate::depth::{Intrinsics, Size};
use crate::ingest::{LengthUnit, TimeUnit, grip_range};
use crate::input::read::{Depth, Settings};
use crate::input::stick::{Manner, SPEED_M_S, SPEEDS_M_S};
use crate::input::{Driver, Habits, Source, Units, read};
use crate::task::Task;

/// A hand that is tracked while it drives.
#[derive(clap::Args, Debug, Clone, Default)]
pub struct InputArgs {
    /// Follow a tracked hand, live: lines of JSON on standard input (-) or in UDP datagrams (udp:PORT on this host,
    /// udp:ADDRESS:PORT), the hand in depth frames (depth:FOLDER of 16-bit PNG, depth:- for raw frames on standard
    /// input), or a gamepad or SpaceMouse (evdev:/dev/input/eventN, where it is built in; evdev: alone lists them);
    /// docs/input.md has the formats.
    #[arg(long, value_name = "SOURCE", conflicts_with_all = ["replay", "play", "console", "correct", "refine"])]
    pub input: Option<Source>,
    /// UDP: hear this sender only; needed to listen beyond this host.
    #[arg(long, value_name = "IP")]
    pub input_from: Option<IpAddr>,
    /// Which joint of a skeleton is the hand [default: right_hand].
    #[arg(long, value_name = "JOINT")]
    pub joint: Option<String>,
    /// Unit of the input's lengths: m, cm or mm [default: m; of depth frames: mm].
    #[arg(long, value_name = "UNIT")]
    pub unit: Option<LengthUnit>,
    /// Unit of the input's times: s, ms, us or ns [default: s].
    #[arg(long, value_name = "UNIT")]
    pub time_unit: Option<TimeUnit>,
    /// Readings of the input's gripper when it is closed and when it is open [default: 0,1].
    #[arg(long, value_name = "CLOSED,OPEN", value_parser = grip_range, allow_hyphen_values = true)]
    pub grip_range: Option<(f64, f64)>,
    /// Depth: the camera's focal lengths and principal point, pixels [default: a Kinect's, for the frames' size].
    #[arg(long, value_name = "FX,FY,CX,CY")]
    pub camera: Option<Intrinsics>,
    /// Depth: left and right are turned around: for a camera in whose picture the person's right hand is on the left.
    #[arg(long)]
    pub mirror: bool,
    /// Depth on standard input: how large a frame is, as 640x480.
    #[arg(long, value_name = "WIDTHxHEIGHT")]
    pub frame_size: Option<Size>,
    /// Depth, a folder: frames a second [default: 30].
    #[arg(long, value_name = "HZ", value_parser = fps)]
    pub fps: Option<f64>,
    /// Gamepad or SpaceMouse: speed of the hand at full deflection, m/s [default: 0.25].
    #[arg(long, value_name = "M_S", value_parser = stick_speed)]
    pub stick_speed: Option<f64>,
    /// Engage with the input's first sample, for a source that says nothing of a clutch. After a loss: type engage.
    #[arg(long)]
    pub engage: bool,
    /// Leave once the input has ended [default: release, and stay].
    #[arg(long)]
    pub until_end: bool,
}

/// `[input]` of the configuration file.
#[derive(Debug, Clone, Default, Deserialize)]
#[serde(deny_unknown_fields)]
pub(super) struct InputFile {
    pub(super) latency_ms: Option<f64>,
    pub(super) glitch_gate: Option<bool>,
    pub(super) source: Option<String>,
    from: Option<IpAddr>,
    joint: Option<String>,
    unit: Option<String>,
    time_unit: Option<String>,
    grip_range: Option<String>,
    camera: Option<String>,
    mirror: Option<bool>,
    frame_size: Option<String>,
    fps: Option<f64>,
    stick_speed_m_s: Option<f64>,
    engage: Option<bool>,
    until_end: Option<bool>,
}

/// Frame rates there are.
fn fps(text: &str) -> Result<f64, String> {
    text.parse()
        .ok()
        .filter(|hz| (1.0..=1000.0).contains(hz))
        .ok_or_else(|| format!("`{text}`: write a rate from 1 to 1000 Hz"))
}

/// Speeds of a hand that a stick moves.
fn stick_speed(text: &str) -> Result<f64, String> {
    let (least, most) = SPEEDS_M_S;
    text.parse()
        .ok()
        .filter(|speed| (least..=most).contains(speed))
        .ok_or_else(|| format!("`{text}`: write a speed from {least} to {most} m/s"))
}

/// A word of the file, as the flag of that name takes it.
fn word<T: std::str::FromStr<Err = String>>(
    key: &str,
    text: Option<String>,
) -> anyhow::Result<Option<T>> {
    let parsed = text.map(|text| text.parse()).transpose();
    parsed.map_err(|e| anyhow::anyhow!("[input] {key} = {e}"))
}

impl InputArgs {
    /// Over what the file says; its source counts only where no flag names another task.
    pub(super) fn over(&mut self, file: InputFile, free: bool) -> anyhow::Result<()> {
        let source = word("source", file.source)?;
        if self.input.is_none() && free {
            self.input = source;
        }
        self.input_from = self.input_from.or(file.from);
        self.joint = self.joint.take().or(file.joint);
        self.unit = self.unit.or(word("unit", file.unit)?);
        self.time_unit = self.time_unit.or(word("time_unit", file.time_unit)?);
        let range = file.grip_range.as_deref().map(grip_range).transpose();
        let range = range.map_err(|e| anyhow::anyhow!("[input] grip_range = {e}"))?;
        self.grip_range = self.grip_range.or(range);
        self.camera = self.camera.or(word("camera", file.camera)?);
        self.mirror |= file.mirror.unwrap_or(false);
        self.frame_size = self.frame_size.or(word("frame_size", file.frame_size)?);
        let rate = file.fps.map(|hz| fps(&hz.to_string())).transpose();
        let rate = rate.map_err(|e| anyhow::anyhow!("[input] fps = {e}"))?;
        self.fps = self.fps.or(rate);
        let speed = file
            .stick_speed_m_s
            .map(|m_s| stick_speed(&m_s.to_string()));
        let speed = speed.transpose();
        let speed = speed.map_err(|e| anyhow::anyhow!("[input] stick_speed_m_s = {e}"))?;
        self.stick_speed = self.stick_speed.or(speed);
        self.engage |= file.engage.unwrap_or(false);
        self.until_end |= file.until_end.unwrap_or(false);
        Ok(())
    }

    /// Whether what is asked for can be, and is in this program.
    pub(super) fn judge(&self) -> anyhow::Result<()> {
        match self.input {
            Some(Source::Evdev(_)) if cfg!(not(feature = "gamepad")) => {
                Err(read::OpenError::NotBuilt.into())
            }
            Some(Source::Evdev(_)) if self.engage => {
                bail!("a gamepad or SpaceMouse has a button to hold: leave --engage out")
            }
            _ => Ok(()),
        }
    }

    /// What has to be there: the folder of frames or the device, if that is the source.
    pub(super) fn path(&self) -> Option<&PathBuf> {
        match &self.input {
            Some(Source::DepthFolder(path) | Source::Evdev(Some(path))) => Some(path),
            _ => None,
        }
    }

    /// The task of following `source`, which is read from now on; `rotation` is from the hand's axes to the robot's base.
    pub(super) fn task(
        &self,
        source: &Source,
        clock: read::Clock,
        rotation: UnitQuaternion<f64>,
        log: &Log,
    ) -> anyhow::Result<Task> {
        let defaults = Units::default();
        let units = Units {
            length: self.unit.unwrap_or(defaults.length),
            time: self.time_unit.unwrap_or(defaults.time),
            grip: self.grip_range.unwrap_or(defaults.grip),
            joint: self.joint.clone().unwrap_or(defaults.joint),
        };
        let depth = Depth::default();
        let settings = Settings {
            from: self.input_from,
            units,
            depth: Depth {
                size: self.frame_size,
                at: self.camera,
                unit: self.unit.unwrap_or(depth.unit),
                mirror: self.mirror,
                fps: self.fps.unwrap_or(depth.fps),
            },
            stick: Manner {
                speed_m_s: self.stick_speed.unwrap_or(SPEED_M_S),
                rotation,
            },
        };
        let (inlet, name) = read::open(source, settings, clock)?;
        log.say(&Event::Input { source: name });
        let habits = Habits {
            engage: self.engage,
            until_end: self.until_end,
        };
        Ok(Task::input(Driver::new(inlet, habits)))
    }
}

/// Prints the gamepads and SpaceMice there are.
///
/// # Errors
/// There is none, and why that may be.
#[cfg(feature = "gamepad")]
pub(super) fn list_devices(json: bool) -> anyhow::Result<()> {
    let listing = crate::input::device::list();
    for found in &listing.found {
        let event = Event::Device {
            source: Source::Evdev(Some(found.path.clone())).to_string(),
            make: found.make.to_string(),
            name: found.name.clone(),
        };
        let line = match event.text() {
            Some(text) if !json => text,
            _ => serde_json::to_string(&event)?,
        };
        telemime_endpoint::cli::say(&line)?;
    }
    let denied = match listing.denied {
        0 => String::new(),
        n => format!(
            "{n} input devices may not be read by this user: `sudo usermod -aG input $USER`, and log in again"
        ),
    };
    match (listing.found.is_empty(), denied.is_empty()) {
        (true, true) => bail!("there is no gamepad and no SpaceMouse on this host"),
        (true, false) => bail!("no gamepad or SpaceMouse is seen; {denied}"),
        (false, false) => eprintln!("{denied}"),
        (false, true) => {}
    }
    Ok(())
}

/// There are none in this build.
#[cfg(not(feature = "gamepad"))]
pub(super) fn list_devices(_json: bool) -> anyhow::Result<()> {
    Err(read::OpenError::NotBuilt.into())
}
