//! A record as a file: one readable line, the circumstances, the chunks, a checksum.
//!
//! ```text
//! telemime black box, format 1; why; N bytes and sha256 follow⏎
//! header (u32 length, codec) · chunks (u32 count, then each u32 length, codec) · SHA-256 of everything before (32 bytes)
//! ```

use std::collections::BTreeMap;
use std::io::Write as _;
use std::path::{Path, PathBuf};

use rustix::fs::statvfs;
use serde::{Deserialize, Serialize};
use sha2::{Digest, Sha256};
use telemime_protocol::wire::DecodeError;
use telemime_protocol::wire::codec;
use telemime_sim::arm::Payload;

use super::recorder::{Chunk, Due, Kept};
use super::ticks::width;
use crate::control::ControlConfig;
use crate::rig::{Rig, RigOptions};
use crate::safety::SafetyConfig;

const LINE: &str = "telemime black box, format ";
const FORMAT: u32 = 1;
const HASH: usize = 32;

/// The longest readable line that is looked for.
const MAX_LINE: usize = 256;
/// Largest header, bytes: an URDF is in it.
const MAX_HEADER: usize = 16 << 20;
/// Largest chunk, bytes.
const MAX_CHUNK: usize = 64 << 20;

/// A stop is not recorded if less than this would be left free, bytes.
const LEFT_ALONE: u64 = 256 << 20;

/// The circumstances of a record: all that a replay needs besides the ticks.
#[derive(Debug, Clone, PartialEq, Serialize, Deserialize)]
pub struct Header {
    /// The program's version.
    pub version: String,
    /// What the URDF was called.
    pub urdf: String,
    /// Its text.
    pub urdf_text: String,
    /// The tip link asked for.
    pub tip: Option<String>,
    /// Joints that were fixed, rad or m.
    pub fixed: BTreeMap<String, f64>,
    /// What the tip carries.
    pub payload: Option<Payload>,
    /// The start posture, rad or m.
    pub home: Vec<f64>,
    /// Bandwidth, limits and tick.
    pub control: ControlConfig,
    /// The state machine's settings.
    pub safety: SafetyConfig,
    /// The command behind which the arm was, if it was not the simulated one.
    pub driver: Option<String>,
}

/// A record from a file, checked and decoded.
#[derive(Debug, Clone)]
pub struct BlackBox {
    /// The circumstances.
    pub header: Header,
    /// What it was written for, in words.
    pub why: String,
    pub(super) chunks: Vec<Chunk>,
}

/// Why a file is no record.
#[derive(Debug, thiserror::Error)]
pub enum ReadError {
    /// The file cannot be read.
    #[error("{path}: {source}")]
    Io {
        /// The file.
        path: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// Something else.
    #[error("{path} is no black box: its first line does not say so")]
    Foreign {
        /// The file.
        path: PathBuf,
    },
    /// Written by another version.
    #[error(
        "{path} has format {found}; this program reads format {FORMAT}: replay it with the version that wrote it"
    )]
    Format {
        /// The file.
        path: PathBuf,
        /// Its format.
        found: u32,
    },
    /// The end is missing.
    #[error("{path} is cut off: {have} of {want} bytes are there; copy it again")]
    Truncated {
        /// The file.
        path: PathBuf,
        /// Bytes after the first line.
        have: usize,
        /// Bytes there should be.
        want: usize,
    },
    /// Bytes were changed, or added.
    #[error("{path} is damaged: its checksum does not fit; copy it again")]
    Damaged {
        /// The file.
        path: PathBuf,
    },
    /// The checksum fits, and still the content is none.
    #[error("{path}: {part}: {source}")]
    Content {
        /// The file.
        path: PathBuf,
        /// Which part.
        part: String,
        /// Why.
        source: DecodeError,
    },
}

/// Why a record was not written.
#[derive(Debug, thiserror::Error)]
pub enum WriteError {
    /// The system does not.
    #[error(
        "the black box cannot be written to {dir}: {source}; make room, or choose another --black-box"
    )]
    Io {
        /// The folder.
        dir: PathBuf,
        /// The system's reason.
        source: std::io::Error,
    },
    /// The rest of the disk is for others.
    #[error(
        "no more stops are written to {dir}: {free} bytes are free on its disk, and {} are left alone; make room, or choose another --black-box",
        LEFT_ALONE
    )]
    Full {
        /// The folder.
        dir: PathBuf,
        /// Bytes free.
        free: u64,
    },
    /// There were enough.
    #[error(
        "no more stops are written to {dir} but the last: it has {most} of this robot's; ask for a record, or start the robot again"
    )]
    Enough {
        /// The folder.
        dir: PathBuf,
        /// Written so far.
        most: u32,
    },
}

/// A record as bytes, all but its checksum.
#[derive(Debug, Clone)]
pub struct Draft(Vec<u8>);

impl Draft {
    /// The record.
    pub fn sealed(self) -> Vec<u8> {
        let Self(mut bytes) = self;
        let hash = Sha256::digest(&bytes);
        bytes.extend(hash);
        bytes
    }
}

impl Due {
    /// For the first line: `stop LeaseExpired`, or `request`.
    pub fn words(self) -> String {
        match self {
            Self::Stop(cause) => format!("stop {cause:?}"),
            Self::Request => "request".to_owned(),
        }
    }
}

impl Header {
    /// The circumstances of a `rig`, behind the command `driver` if its arm is not the simulated one.
    pub fn new(rig: &Rig, driver: Option<String>) -> Self {
        let (urdf, urdf_text, options) = rig.made_of();
        // Every option is recorded, or a replay would be of another rig.
        let RigOptions {
            urdf: _,
            load,
            start: _,
            control,
            safety,
            driver: _,
            // Where the arm is, whatever pushed it there, is recorded.
            contact: _,
        } = options.clone();
        Self {
            version: env!("CARGO_PKG_VERSION").to_owned(),
            urdf: urdf.to_owned(),
            urdf_text: urdf_text.to_owned(),
            tip: load.tip,
            fixed: load.fixed,
            payload: load.payload,
            home: rig.home.iter().take(rig.arm.dof()).copied().collect(),
            control,
            safety,
            driver,
        }
    }

    /// The options of the rig that was driven.
    pub fn options(&self) -> RigOptions {
        RigOptions {
            urdf: None,
            load: telemime_sim::arm::LoadOptions {
                tip: self.tip.clone(),
                fixed: self.fixed.clone(),
                payload: self.payload,
            },
            start: Some(self.home.clone()),
            control: self.control,
            safety: self.safety,
            driver: self.driver.is_some(),
            contact: None,
        }
    }

    pub(super) fn draft(&self, due: Due, chunks: &[&Kept]) -> Draft {
        let header = codec::encode(self);
        let size = chunks
            .iter()
            .map(|kept| kept.bytes.len() + 4)
            .sum::<usize>();
        let body = 4 + header.len() + 4 + size;
        let line = format!(
            "{LINE}{FORMAT}; {}; {body} bytes and sha256 follow\n",
            due.words()
        );
        let mut bytes = Vec::with_capacity(line.len() + body + HASH);
        bytes.extend(line.as_bytes());
        let mut part = |part: &[u8]| {
            bytes.extend((part.len() as u32).to_le_bytes());
            bytes.extend(part);
        };
        part(&header);
        let count = (chunks.len() as u32).to_le_bytes();
        bytes.extend(count);
        for kept in chunks {
            bytes.extend((kept.bytes.len() as u32).to_le_bytes());
            bytes.extend(&kept.bytes);
        }
        Draft(bytes)
    }
}

/// Writes `bytes` into `dir` as a file of its own: whole or not at all, and never over another. Returns its path. That of a stop leaves 256 MiB of the
/// disk free, or is not written.
///
/// # Errors
/// [`WriteError`].
pub fn write(dir: &Path, due: Due, bytes: &[u8]) -> Result<PathBuf, WriteError> {
    let wrong = |source| WriteError::Io {
        dir: dir.to_owned(),
        source,
    };
    let free = statvfs(dir).map_err(|e| wrong(e.into()))?;
    let free = free.f_bavail.saturating_mul(free.f_frsize);
    if !has_room(due, bytes.len() as u64, free) {
        let dir = dir.to_owned();
        return Err(WriteError::Full { dir, free });
    }
    let name = due.words().replace(' ', "-").to_lowercase();
    let mut file = tempfile::Builder::new()
        .prefix(".blackbox-")
        .tempfile_in(dir)
        .map_err(wrong)?;
    file.write_all(bytes).map_err(wrong)?;
    file.as_file().sync_all().map_err(wrong)?;
    for n in next_number(dir).map_err(wrong)?.. {
        let path = dir.join(format!("{n:04}-{name}.blackbox"));
        match file.persist_noclobber(&path) {
            Ok(_) => return Ok(path),
            // Somebody else has just taken the name.
            Err(e) if e.error.kind() == std::io::ErrorKind::AlreadyExists => file = e.file,
            Err(e) => return Err(wrong(e.error)),
        }
    }
    Err(wrong(std::io::ErrorKind::AlreadyExists.into()))
}

pub(super) fn has_room(due: Due, bytes: u64, free: u64) -> bool {
    due == Due::Request || free >= bytes.saturating_add(LEFT_ALONE)
}

/// One more than the highest number in front of a record's name.
fn next_number(dir: &Path) -> std::io::Result<u32> {
    let mut highest = 0_u32;
    for entry in std::fs::read_dir(dir)? {
        let name = entry?.file_name();
        let name = name.to_string_lossy();
        let number = name
            .strip_suffix(".blackbox")
            .and_then(|name| name.split('-').next());
        highest = highest.max(number.and_then(|n| n.parse().ok()).unwrap_or(0));
    }
    Ok(highest.saturating_add(1))
}

impl BlackBox {
    /// Reads a file.
    ///
    /// # Errors
    /// [`ReadError`], one variant a cause.
    pub fn load(path: &Path) -> Result<Self, ReadError> {
        let bytes = std::fs::read(path).map_err(|source| ReadError::Io {
            path: path.to_owned(),
            source,
        })?;
        Self::parse(path, &bytes)
    }

    /// Reads the `bytes` of a file that is called `path`.
    ///
    /// # Errors
    /// [`ReadError`], but for [`ReadError::Io`].
    pub fn parse(path: &Path, bytes: &[u8]) -> Result<Self, ReadError> {
        let foreign = || ReadError::Foreign {
            path: path.to_owned(),
        };
        let end = bytes.iter().take(MAX_LINE).position(|b| *b == b'\n');
        let (line, rest) = bytes.split_at(end.ok_or_else(foreign)?);
        let line = std::str::from_utf8(line)
            .ok()
            .and_then(|line| line.strip_prefix(LINE));
        let mut words = line.ok_or_else(foreign)?.split("; ");
        let format = words
            .next()
            .and_then(|n| n.parse().ok())
            .ok_or_else(foreign)?;
        if format != FORMAT {
            return Err(ReadError::Format {
                path: path.to_owned(),
                found: format,
            });
        }
        let why = words.next().ok_or_else(foreign)?.to_owned();
        let size = words
            .next()
            .and_then(|text| text.strip_suffix(" bytes and sha256 follow"));
        let size: usize = size.and_then(|n| n.parse().ok()).ok_or_else(foreign)?;
        let (have, want) = (rest.len() - 1, size.saturating_add(HASH));
        if have < want {
            return Err(ReadError::Truncated {
                path: path.to_owned(),
                have,
                want,
            });
        }
        let damaged = || ReadError::Damaged {
            path: path.to_owned(),
        };
        let (told, hash) = bytes.split_at(bytes.len() - HASH);
        if have > want || Sha256::digest(told)[..] != *hash {
            return Err(damaged());
        }
        let mut rest = &rest[1..1 + size];
        let content = |part: String| {
            let path = path.to_owned();
            move |source| ReadError::Content { path, part, source }
        };
        let header = next(&mut rest).ok_or_else(damaged)?;
        let header: Header =
            codec::decode::<_, MAX_HEADER>(header).map_err(content("header".into()))?;
        let count = number(&mut rest).ok_or_else(damaged)?;
        let mut chunks = Vec::new();
        for n in 0..count {
            let chunk = next(&mut rest).ok_or_else(damaged)?;
            let chunk: Chunk =
                codec::decode::<_, MAX_CHUNK>(chunk).map_err(content(format!("second {n}")))?;
            if header.home.len() > telemime_sim::arm::MAX_JOINTS
                || !chunk.words.len().is_multiple_of(width(header.home.len()))
                || !chunk.is_sound()
            {
                return Err(damaged());
            }
            chunks.push(chunk);
        }
        if chunks.is_empty() || !rest.is_empty() {
            return Err(damaged());
        }
        Ok(Self {
            header,
            why,
            chunks,
        })
    }

    /// The rig that was driven.
    ///
    /// # Errors
    /// [`RigError`](crate::rig::RigError).
    pub fn rig(&self) -> Result<Rig, crate::rig::RigError> {
        let header = &self.header;
        Rig::read(header.urdf.clone(), &header.urdf_text, &header.options())
    }

    /// Ticks recorded.
    pub fn ticks(&self) -> u64 {
        let width = width(self.header.home.len());
        self.chunks
            .iter()
            .map(|c| (c.words.len() / width) as u64)
            .sum()
    }
}

fn number(rest: &mut &[u8]) -> Option<usize> {
    let (n, after) = rest.split_first_chunk::<4>()?;
    *rest = after;
    Some(u32::from_le_bytes(*n) as usize)
}

fn next<'a>(rest: &mut &'a [u8]) -> Option<&'a [u8]> {
    let n = number(rest)?;
    let (part, after) = rest.split_at_checked(n)?;
    *rest = after;
    Some(part)
}
