//! Skills on disk: read whole, written whole or not at all.

use std::fs;
use std::io::{self, Write};
use std::path::{Path, PathBuf};

use telemime_protocol::skill::{FileError, Skill};

/// Why a skill file cannot be read or written.
#[derive(Debug, thiserror::Error)]
pub enum SkillFileError {
    /// The file system refused.
    #[error("{}: {source}; check that it exists and may be used", path.display())]
    Io {
        /// The file.
        path: PathBuf,
        /// What the system said.
        source: io::Error,
    },
    /// The file is not a usable skill.
    #[error("{}: {source}{}", path.display(), remedy(source))]
    Content {
        /// The file.
        path: PathBuf,
        /// What is wrong with it.
        source: FileError,
    },
}

/// What to do about it, where the fault does not say.
fn remedy(fault: &FileError) -> &'static str {
    match fault {
        FileError::NotASkill => "; `telemime learn` makes one",
        FileError::Length { .. } | FileError::Checksum => {
            "; copy it again, or learn the skill again"
        }
        _ => "",
    }
}

/// Reads a skill file.
///
/// # Errors
/// [`SkillFileError`].
pub fn load(path: impl AsRef<Path>) -> Result<Skill, SkillFileError> {
    let path = path.as_ref();
    let bytes = fs::read(path).map_err(|source| io_error(path, source))?;
    Skill::from_file(&bytes).map_err(|source| SkillFileError::Content {
        path: path.to_owned(),
        source,
    })
}

/// Writes a skill file: beside its place first, then moved there, so that a crash leaves the old one.
///
/// # Errors
/// [`SkillFileError::Io`].
pub fn save(skill: &Skill, path: impl AsRef<Path>) -> Result<(), SkillFileError> {
    let path = path.as_ref();
    let mut name = path.as_os_str().to_owned();
    name.push(format!(".{}.part", std::process::id()));
    let beside = PathBuf::from(name);
    let write = || {
        let mut file = fs::File::create(&beside)?;
        file.write_all(&skill.to_file())?;
        file.sync_all()?;
        fs::rename(&beside, path)
    };
    write().map_err(|source| {
        // Nothing half-written stays; that it could not be created is the error reported.
        let _ = fs::remove_file(&beside);
        io_error(path, source)
    })
}

fn io_error(path: &Path, source: io::Error) -> SkillFileError {
    SkillFileError::Io {
        path: path.to_owned(),
        source,
    }
}

#[cfg(test)]
mod tests {
    use nalgebra::Vector3;

    use super::*;
    use crate::demonstration::{Demonstration, Sample};
    use crate::learn::{LearnOptions, learn_skill};

    #[test]
    fn a_skill_survives_the_disk_and_faults_name_the_file() {
        let samples: Vec<_> = (0..30)
            .map(|i| {
                Sample::at(
                    f64::from(i) / 30.0,
                    Vector3::new(f64::from(i) * 0.01, 0.0, 0.0),
                )
            })
            .collect();
        let demo = Demonstration::from_samples("line", &samples).unwrap();
        let skill = learn_skill("line", &[demo], &LearnOptions::default(), |_| ()).unwrap();
        let dir = tempfile::tempdir().unwrap();
        let path = dir.path().join("line.skill");
        save(&skill, &path).unwrap();
        save(&skill, &path).unwrap();
        assert_eq!(load(&path).unwrap(), skill);
        assert_eq!(fs::read_dir(dir.path()).unwrap().count(), 1);

        fs::write(&path, "t,x,y,z\n").unwrap();
        let message = load(&path).unwrap_err().to_string();
        assert!(
            message.ends_with("line.skill: not a Telemime skill file; `telemime learn` makes one"),
            "{message}"
        );
        let mut bytes = skill.to_file();
        let middle = bytes.len() / 2;
        bytes[middle] ^= 1;
        fs::write(&path, &bytes).unwrap();
        let message = load(&path).unwrap_err().to_string();
        assert!(
            message.ends_with("; copy it again, or learn the skill again"),
            "{message}"
        );
        assert!(save(&skill, dir.path().join("no/such/folder")).is_err());
        assert!(load(dir.path().join("none")).is_err());
    }
}
