//! The shape of the workspace: nothing forgotten, nothing that does not belong.

use std::collections::BTreeSet;
use std::fs;
use std::path::Path;

/// All that may stand at the top level.
const TOP_LEVEL: [&str; 19] = [
    ".ci",
    ".gitignore",
    "ARCHITECTURE.md",
    "CHANGELOG.md",
    "CONTRIBUTING.md",
    "Cargo.lock",
    "Cargo.toml",
    "LICENSE-APACHE",
    "LICENSE-MIT",
    "README.md",
    "clippy.toml",
    "deny.toml",
    "docs",
    "operator",
    "protocol",
    "robot",
    "sim",
    "src",
    "tests",
];

/// What .gitignore leaves out, and the repository itself.
const NOT_OURS: [&str; 3] = [".git", "runs", "target"];

fn root() -> &'static Path {
    Path::new(env!("CARGO_MANIFEST_DIR"))
}

fn names(folder: &Path) -> BTreeSet<String> {
    fs::read_dir(folder)
        .unwrap()
        .map(|entry| entry.unwrap().file_name().into_string().unwrap())
        .collect()
}

#[test]
fn every_file_of_this_folder_is_a_module() {
    let main = fs::read_to_string(root().join("tests/it/main.rs")).unwrap();
    let declared: BTreeSet<_> = main
        .lines()
        .filter_map(|line| line.strip_prefix("mod ")?.strip_suffix(';'))
        .map(str::to_owned)
        .collect();
    let there: BTreeSet<_> = names(&root().join("tests/it"))
        .iter()
        .filter(|name| *name != "main.rs")
        .map(|name| name.trim_end_matches(".rs").to_owned())
        .collect();
    assert_eq!(declared, there);
}

#[test]
fn tests_have_one_binary() {
    let tests = names(&root().join("tests"));
    let stray: Vec<_> = tests.iter().filter(|n| n.ends_with(".rs")).collect();
    assert!(stray.is_empty(), "{stray:?} would be binaries of their own");
}

#[test]
fn the_top_level_holds_what_was_agreed() {
    let agreed = BTreeSet::from(TOP_LEVEL);
    let there = names(root());
    let there: BTreeSet<_> = there
        .iter()
        .map(String::as_str)
        .filter(|name| !NOT_OURS.contains(name) && !name.ends_with(".tmp"))
        .collect();
    let unexpected: Vec<_> = there.difference(&agreed).collect();
    let missing: Vec<_> = agreed.difference(&there).collect();
    assert!(
        unexpected.is_empty() && missing.is_empty(),
        "unexpected {unexpected:?}, missing {missing:?}"
    );
}

/// All Rust code below `folder`.
fn code(folder: &Path, into: &mut String) {
    for entry in fs::read_dir(folder).unwrap() {
        let path = entry.unwrap().path();
        if path.is_dir() {
            code(&path, into);
        } else if path.extension().is_some_and(|e| e == "rs") {
            into.push_str(&fs::read_to_string(path).unwrap());
        }
    }
}

#[test]
fn every_test_that_the_safety_document_names_exists() {
    let mut all = String::new();
    for folder in ["operator", "protocol", "robot", "sim", "src", "tests"] {
        code(&root().join(folder), &mut all);
    }
    let text = fs::read_to_string(root().join("docs/safety.md")).unwrap();
    let named: BTreeSet<_> = text
        .split('`')
        .filter(|name| {
            name.matches('_').count() >= 3
                && name.chars().all(|c| c == '_' || c.is_ascii_alphanumeric())
        })
        .collect();
    assert!(named.len() > 10, "{named:?}");
    let missing: Vec<_> = named
        .iter()
        .filter(|name| !all.contains(&format!("fn {name}(")))
        .collect();
    assert!(missing.is_empty(), "no test is called {missing:?}");
}
