//! Gamepads and SpaceMice of this host, by the kernel's event interface (feature `gamepad`).

use std::fs::{self, File, OpenOptions};
use std::io;
use std::os::unix::fs::OpenOptionsExt;
use std::path::{Path, PathBuf};

use evdev::raw_stream::RawDevice;
use evdev::{EventType, InputEvent, SynchronizationCode};
use rustix::fs::OFlags;
use telemime_protocol::time::Stamp;

use super::stick::{Abilities, Change, Control, Layout, Make, Manner, Range, Stick};

/// Where the kernel puts them.
const FOLDER: &str = "/dev/input";

/// At most this many reads a tick, of some thirty reports each: more than the kernel keeps for a reader, so that a device which
/// never ends talking cannot hold the thread.
const MOST_READS: usize = 32;

/// Why a device cannot be used.
#[derive(Debug, thiserror::Error)]
pub enum DeviceError {
    /// It may not be read.
    #[error(
        "{path} may not be read by this user: `sudo usermod -aG input $USER`, and log in again"
    )]
    Denied {
        /// The device.
        path: PathBuf,
    },
    /// It cannot be opened.
    #[error("{path}: {source}; `--input evdev:` lists what there is")]
    Open {
        /// The device.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// What was opened does not answer as an input device does.
    #[error("{path} is no input device ({source}); `--input evdev:` lists what there is")]
    NoInput {
        /// What was opened.
        path: PathBuf,
        /// The system's reason.
        source: io::Error,
    },
    /// A keyboard, for example.
    #[error(
        "{path} ({name}) is neither a gamepad nor a SpaceMouse; `--input evdev:` lists what could be one"
    )]
    Unlike {
        /// The device.
        path: PathBuf,
        /// What it calls itself.
        name: String,
    },
    /// Somebody else takes all that it says.
    #[error("{path} is taken by another program (spacenavd, for example: stop it first)")]
    Taken {
        /// The device.
        path: PathBuf,
    },
}

/// A device that could drive.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct Found {
    /// Where it is.
    pub path: PathBuf,
    /// What it calls itself.
    pub name: String,
    /// What it is.
    pub make: Make,
}

/// What there is on this host.
#[derive(Debug, Default)]
pub struct Listing {
    /// What could drive, in the order of their numbers.
    pub found: Vec<Found>,
    /// How many devices could not be looked at, for want of a permission.
    pub denied: usize,
}

/// Looks for devices that could drive.
pub fn list() -> Listing {
    let number = |path: &PathBuf| -> Option<u32> {
        let name = path.file_name()?.to_str()?;
        name.strip_prefix("event")?.parse().ok()
    };
    // A host without the folder has no devices.
    let entries = fs::read_dir(FOLDER).into_iter().flatten().flatten();
    let mut paths: Vec<_> = entries
        .map(|entry| entry.path())
        .filter_map(|path| Some((number(&path)?, path)))
        .collect();
    paths.sort();
    let mut listing = Listing::default();
    for (_, path) in paths {
        match look(&path) {
            Ok((device, layout)) => listing.found.push(Found {
                name: name(&device),
                make: layout.make,
                path,
            }),
            Err(DeviceError::Denied { .. }) => listing.denied += 1,
            Err(_) => {}
        }
    }
    listing
}

fn name(device: &RawDevice) -> String {
    let name = device.name().unwrap_or("without a name");
    // It comes out of the device, and goes to a terminal.
    name.chars().filter(|c| !c.is_control()).collect()
}

/// Opens a device without taking it, and says what it is.
fn look(path: &Path) -> Result<(RawDevice, Layout), DeviceError> {
    let path = || path.to_owned();
    // Reading must not wait: a tick is due whether or not anything was reported.
    let flags = OFlags::NONBLOCK.bits().cast_signed();
    let file: File = OpenOptions::new()
        .read(true)
        .custom_flags(flags)
        .open(path())
        .map_err(|source| match source.kind() {
            io::ErrorKind::PermissionDenied => DeviceError::Denied { path: path() },
            _ => DeviceError::Open {
                path: path(),
                source,
            },
        })?;
    let no_input = |source| DeviceError::NoInput {
        path: path(),
        source,
    };
    let device = RawDevice::from_fd(file.into()).map_err(no_input)?;
    let has = abilities(&device).map_err(no_input)?;
    match Layout::of(&has) {
        Some(layout) => Ok((device, layout)),
        None => Err(DeviceError::Unlike {
            path: path(),
            name: name(&device),
        }),
    }
}

fn abilities(device: &RawDevice) -> io::Result<Abilities> {
    let keys = device.supported_keys().into_iter().flat_map(|k| k.iter());
    let relative = device.supported_relative_axes().into_iter();
    let absolute = device.get_absinfo()?.map(|(axis, info)| {
        let (low, high) = (info.minimum(), info.maximum());
        (axis.0, Range { low, high })
    });
    Ok(Abilities {
        keys: keys.map(|key| key.0).collect(),
        absolute: absolute.collect(),
        relative: relative.flat_map(|r| r.iter()).map(|r| r.0).collect(),
    })
}

/// A device that is read.
#[derive(Debug)]
pub(super) struct Device {
    raw: RawDevice,
    /// The kernel's own account is newer than what was read: at the beginning, and after reports were lost.
    behind: bool,
}

impl Device {
    /// Takes the device at `path` for this program alone; with it, what it is called and the hand it moves.
    ///
    /// # Errors
    /// [`DeviceError`].
    pub(super) fn open(path: &Path, manner: Manner) -> Result<(Self, Stick, String), DeviceError> {
        let (mut raw, layout) = look(path)?;
        raw.grab().map_err(|source| match source.kind() {
            io::ErrorKind::ResourceBusy => DeviceError::Taken {
                path: path.to_owned(),
            },
            _ => DeviceError::Open {
                path: path.to_owned(),
                source,
            },
        })?;
        let name = format!("evdev:{} ({}, {})", path.display(), name(&raw), layout.make);
        let device = Self { raw, behind: true };
        Ok((device, Stick::new(&layout, manner), name))
    }

    /// Hands what was reported so far to `stick`.
    ///
    /// # Errors
    /// The device is gone.
    pub(super) fn read(&mut self, stick: &mut Stick, now: Stamp) -> io::Result<()> {
        for _ in 0..MOST_READS {
            let mut any = false;
            match self.raw.fetch_events() {
                Ok(events) => {
                    for event in events {
                        any = true;
                        self.behind |= is_loss(&event);
                        if let Some(change) = change(&event, now) {
                            stick.handle(change);
                        }
                    }
                }
                Err(e) if e.kind() == io::ErrorKind::WouldBlock => {}
                Err(e) if e.kind() == io::ErrorKind::Interrupted => continue,
                Err(e) => return Err(e),
            }
            if !any {
                break;
            }
        }
        if std::mem::take(&mut self.behind) {
            self.catch_up(stick, now)?;
        }
        Ok(())
    }

    /// Hands over everything as the kernel has it now.
    fn catch_up(&self, stick: &mut Stick, now: Stamp) -> io::Result<()> {
        let mut say = |control, code, value| {
            stick.handle(Change {
                control,
                code,
                value,
                t: now,
            });
        };
        let down = self.raw.get_key_state()?;
        for key in self.raw.supported_keys().into_iter().flat_map(|k| k.iter()) {
            say(Control::Key, key.0, i32::from(down.contains(key)));
        }
        for (axis, info) in self.raw.get_absinfo()? {
            say(Control::Absolute, axis.0, info.value());
        }
        Ok(())
    }
}

/// The kernel had no room for more, and what is read next is not all there was.
fn is_loss(event: &InputEvent) -> bool {
    event.event_type() == EventType::SYNCHRONIZATION
        && event.code() == SynchronizationCode::SYN_DROPPED.0
}

fn change(event: &InputEvent, t: Stamp) -> Option<Change> {
    let control = match event.event_type() {
        EventType::KEY => Control::Key,
        EventType::ABSOLUTE => Control::Absolute,
        EventType::RELATIVE => Control::Relative,
        _ => return None,
    };
    Some(Change {
        control,
        code: event.code(),
        value: event.value(),
        t,
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_is_no_gamepad_is_refused_with_what_to_do() {
        let refused = |path: &str| look(Path::new(path)).unwrap_err();
        assert!(matches!(refused("/dev/null"), DeviceError::NoInput { .. }));
        let dir = tempfile::tempdir().unwrap();
        let file = dir.path().join("event0");
        fs::write(&file, "no device").unwrap();
        let error = refused(file.to_str().unwrap());
        assert!(matches!(error, DeviceError::NoInput { .. }), "{error}");
        let error = refused(dir.path().join("event1").to_str().unwrap());
        assert!(matches!(error, DeviceError::Open { .. }), "{error}");
        assert!(error.to_string().contains("--input evdev:"), "{error}");
    }

    #[test]
    fn reports_keep_their_kind_and_a_loss_of_them_is_told_from_a_sync() {
        let event = |kind: EventType, code, value| InputEvent::new(kind.0, code, value);
        let key = change(&event(EventType::KEY, 0x136, 1), Stamp(5)).unwrap();
        let expected = Change {
            control: Control::Key,
            code: 0x136,
            value: 1,
            t: Stamp(5),
        };
        assert_eq!(key, expected);
        let sync = event(EventType::SYNCHRONIZATION, 0, 0);
        let lost = event(EventType::SYNCHRONIZATION, 3, 0);
        assert_eq!((is_loss(&sync), is_loss(&lost)), (false, true));
        assert!(!is_loss(&event(EventType::KEY, 3, 0)));
        assert_eq!(change(&sync, Stamp(5)), None);
    }
}
