//! `telemime list`.

use std::path::{Path, PathBuf};

use anyhow::{Context, bail};
use serde::Serialize;
use telemime_operator::skill_file;
use telemime_protocol::skill::Skill;

/// List the skills there are: of folders every *.skill, of files themselves.
///
/// A file that is no usable skill is listed with what is wrong with it, and makes the exit code 1.
#[derive(clap::Args, Debug)]
pub(crate) struct ListArgs {
    /// Folders and skill files.
    #[arg(value_name = "DIR|FILE", default_value = ".")]
    places: Vec<PathBuf>,
    /// One JSON object on stdout.
    #[arg(long)]
    json: bool,
}

/// What the list says about one skill.
#[derive(Debug, Serialize)]
struct Entry {
    file: String,
    name: String,
    id: String,
    demonstrations: usize,
    duration_s: f64,
    motion_components: usize,
    predictor_components: usize,
    bytes: usize,
}

/// A file that is not a skill.
#[derive(Debug, Serialize)]
struct Damaged {
    file: String,
    error: String,
}

#[derive(Debug, Serialize)]
struct Listing {
    skills: Vec<Entry>,
    damaged: Vec<Damaged>,
}

/// Every skill file of the places, in order of name within a folder.
pub(super) fn skill_files(places: &[PathBuf]) -> anyhow::Result<Vec<PathBuf>> {
    let mut files = Vec::new();
    for place in places {
        let kind = std::fs::metadata(place)
            .with_context(|| format!("cannot look at {}", place.display()))?;
        if !kind.is_dir() {
            files.push(place.clone());
            continue;
        }
        let mut found = Vec::new();
        let folder = || format!("cannot read the folder {}", place.display());
        for entry in std::fs::read_dir(place).with_context(folder)? {
            let path = entry.with_context(folder)?.path();
            if path.extension().is_some_and(|e| e == "skill") {
                found.push(path);
            }
        }
        found.sort();
        files.extend(found);
    }
    Ok(files)
}

pub(crate) fn list(args: &ListArgs) -> anyhow::Result<()> {
    let files = skill_files(&args.places)?;
    let mut listing = Listing {
        skills: Vec::new(),
        damaged: Vec::new(),
    };
    for file in &files {
        match skill_file::load(file) {
            Ok(skill) => listing.skills.push(Entry::of(file, &skill)),
            Err(error) => listing.damaged.push(Damaged {
                file: file.display().to_string(),
                error: error.to_string(),
            }),
        }
    }
    if args.json {
        say!("{}", serde_json::to_string(&listing)?);
    } else {
        show(&listing, &args.places);
    }
    match listing.damaged.len() {
        0 => Ok(()),
        n => bail!("{n} of {} files are no usable skills", files.len()),
    }
}

impl Entry {
    fn of(file: &Path, skill: &Skill) -> Self {
        Self {
            file: file.display().to_string(),
            name: skill.name().to_owned(),
            id: skill.id().to_string(),
            demonstrations: skill.provenance().sources.len(),
            duration_s: skill.duration_s(),
            motion_components: skill.motion().components().len(),
            predictor_components: skill.predictor().components().len(),
            bytes: skill.to_bytes().len(),
        }
    }
}

fn show(listing: &Listing, places: &[PathBuf]) {
    if listing.skills.is_empty() && listing.damaged.is_empty() {
        let places: Vec<_> = places.iter().map(|p| p.display().to_string()).collect();
        say!(
            "no *.skill in {}; telemime learn DIR makes one",
            places.join(", ")
        );
        return;
    }
    let width = |of: &dyn Fn(&Entry) -> usize, head: &str| {
        let widest = listing.skills.iter().map(of).max().unwrap_or(0);
        widest.max(head.len())
    };
    if !listing.skills.is_empty() {
        let name = width(&|e| e.name.chars().count(), "name");
        say!(
            "{:name$}  {:32}  demos  duration  components  bytes   file",
            "name",
            "id"
        );
        for e in &listing.skills {
            say!(
                "{:name$}  {:32}  {:5}  {:6.2} s  {:3} + {:<4}  {:6}  {}",
                e.name,
                e.id,
                e.demonstrations,
                e.duration_s,
                e.motion_components,
                e.predictor_components,
                e.bytes,
                e.file
            );
        }
    }
    for d in &listing.damaged {
        say!("damaged: {}", d.error);
    }
}
