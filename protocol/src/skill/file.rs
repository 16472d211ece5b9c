//! A skill as a file: one readable line that states format version and units, the encoding, a checksum.
//!
//! ```text
//! telemime skill, format 1; m, s; "wave", 78412 bytes and sha256 follow\n
//! <payload: the skill's encoding> <32 bytes: SHA-256 of everything before>
//! ```

use super::{MAX_SKILL_BYTES, Skill, SkillError, sha256};

const MAGIC: &str = "telemime skill, format ";
const VERSION: u32 = 1;
const UNITS: &str = "m, s";
const CHECKSUM: usize = 32;
/// No header is longer: a name of 64 bytes, escaped, and the fixed words.
const MAX_HEADER: usize = 1024;

/// Why a file is not a skill that can be loaded.
#[derive(Debug, Clone, PartialEq, thiserror::Error)]
pub enum FileError {
    /// The first line is not that of a skill file.
    #[error("not a Telemime skill file")]
    NotASkill,
    /// Written by a newer (or unknown) version.
    #[error(
        "skill file format {found}; this program reads format {VERSION}: learn the skill again"
    )]
    Version {
        /// The version the file states.
        found: u32,
    },
    /// The units are not metres and seconds.
    #[error("skill file in units {found:?}, expected {UNITS:?}")]
    Units {
        /// The units the file states.
        found: String,
    },
    /// Bytes are missing or left over.
    #[error("skill file damaged: {found} bytes after the first line, it states {stated}")]
    Length {
        /// Payload and checksum found.
        found: usize,
        /// Payload and checksum stated.
        stated: usize,
    },
    /// The checksum does not fit the content.
    #[error("skill file damaged: its checksum does not fit")]
    Checksum,
    /// Intact, but not a valid skill.
    #[error(transparent)]
    Skill(#[from] SkillError),
}

impl Skill {
    /// The content of a skill file.
    pub fn to_file(&self) -> Vec<u8> {
        let payload = self.to_bytes();
        let mut file = format!(
            "{MAGIC}{VERSION}; {UNITS}; {:?}, {} bytes and sha256 follow\n",
            self.name(),
            payload.len()
        )
        .into_bytes();
        file.extend_from_slice(payload);
        let checksum = sha256(&file);
        file.extend_from_slice(&checksum);
        file
    }

    /// Reads the content of a skill file.
    ///
    /// # Errors
    /// [`FileError`], one variant a cause.
    pub fn from_file(file: &[u8]) -> Result<Self, FileError> {
        let head = &file[..file.len().min(MAX_HEADER)];
        let end = head
            .iter()
            .position(|&b| b == b'\n')
            .ok_or(FileError::NotASkill)?;
        let line = core::str::from_utf8(&head[..end]).map_err(|_| FileError::NotASkill)?;
        let rest = line.strip_prefix(MAGIC).ok_or(FileError::NotASkill)?;
        let (version, rest) = rest.split_once("; ").ok_or(FileError::NotASkill)?;
        match version.parse() {
            Ok(VERSION) => {}
            Ok(found) => return Err(FileError::Version { found }),
            Err(_) => return Err(FileError::NotASkill),
        }
        let (units, rest) = rest.split_once("; ").ok_or(FileError::NotASkill)?;
        if units != UNITS {
            return Err(FileError::Units {
                found: units.to_owned(),
            });
        }
        let stated: usize = rest
            .strip_suffix(" bytes and sha256 follow")
            .and_then(|r| r.rsplit_once(", "))
            .and_then(|(_, n)| n.parse().ok())
            .filter(|&n| n <= MAX_SKILL_BYTES)
            .ok_or(FileError::NotASkill)?;
        let body = &file[end + 1..];
        if body.len() != stated + CHECKSUM {
            return Err(FileError::Length {
                found: body.len(),
                stated: stated + CHECKSUM,
            });
        }
        let (content, checksum) = file.split_at(file.len() - CHECKSUM);
        if sha256(content) != checksum {
            return Err(FileError::Checksum);
        }
        Ok(Self::from_bytes(&body[..stated])?)
    }
}
