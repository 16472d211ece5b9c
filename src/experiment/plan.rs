//! A plan: TOML, checked, and crossed into a list of runs.

use std::collections::BTreeSet;
use std::ops::Range;
use std::path::{Path, PathBuf};

use sha2::{Digest, Sha256};
use telemime_operator::cli::Axes;
use telemime_operator::demonstration::PersonPattern;
use toml::Spanned;
use toml::de::{DeTable, DeValue};

use super::factor::{FACTORS, LINK, Settings, Texts, UNUSED, index, of, seen_by};

/// More runs than this are a slip.
const MOST_RUNS: usize = 1_000_000;

/// A checked plan.
#[derive(Debug)]
pub(super) struct Plan {
    pub(super) title: String,
    /// Of everything that is drawn but the link's chances, which have seeds of their own.
    pub(super) seed: u64,
    pub(super) motion: Motion,
    /// The runs of one subject, in order, each once.
    pub(super) cells: Vec<Cell>,
    /// The plan as it was written.
    pub(super) text: String,
    /// Paths in it begin here.
    pub(super) folder: PathBuf,
}

/// One setting of all factors.
#[derive(Debug, Clone)]
pub(super) struct Cell {
    /// As the results state it.
    pub(super) texts: Texts,
    pub(super) settings: Settings,
}

/// What is learned from and what is driven.
#[derive(Debug, Clone)]
pub(super) struct Motion {
    /// Generated people, if there are no folders.
    pub(super) people: u64,
    /// Generated performances that each is learned from.
    pub(super) performances: u32,
    /// Generated hands have an orientation, too.
    pub(super) wrist: bool,
    /// Recordings, a skill a folder.
    pub(super) folders: Vec<PathBuf>,
    /// Recordings of other motion.
    pub(super) off_model: Vec<PathBuf>,
    pub(super) matching: Option<String>,
    pub(super) persons: PersonPattern,
    /// Most recordings of a person that a skill is learned from.
    pub(super) learn_from: usize,
    /// Each recording is driven, and not each person's last only.
    pub(super) every: bool,
    pub(super) axes: Axes,
    /// Only so many subjects.
    pub(super) most: Option<usize>,
}

impl Default for Motion {
    fn default() -> Self {
        Self {
            people: 3,
            performances: 5,
            wrist: false,
            folders: Vec::new(),
            off_model: Vec::new(),
            matching: None,
            persons: PersonPattern::default(),
            learn_from: 3,
            every: false,
            axes: Axes::Kinect,
            most: None,
        }
    }
}

/// Why a plan is none: where, and what to do.
#[derive(Debug, PartialEq, thiserror::Error)]
#[error("{plan}:{line}: {problem}")]
pub(super) struct PlanError {
    /// The file, or the ready plan's name.
    plan: String,
    /// From 1 on.
    line: usize,
    problem: Problem,
}

/// What is wrong with a plan.
#[derive(Debug, PartialEq, thiserror::Error)]
pub(super) enum Problem {
    #[error("{0}")]
    Syntax(String),
    #[error("unknown key `{key}`; here may stand {known}")]
    Key { key: String, known: String },
    #[error("unknown factor `{name}`; there are {known}")]
    Factor { name: String, known: String },
    #[error("{factor} = {text:?}: {why}")]
    Value {
        factor: String,
        text: String,
        why: String,
    },
    #[error("`{key}` must be {what}")]
    Type { key: String, what: &'static str },
    #[error("{}: no such folder; paths begin at the plan's folder", .0.display())]
    Folder(PathBuf),
    #[error("`{0}` names no value")]
    Nothing(String),
    #[error(
        "`{key}` does nothing {}",
        if *recorded { "beside `folders`: recordings are driven, and nobody is generated" } else { "without `folders`: nothing recorded is driven" }
    )]
    Idle { key: String, recorded: bool },
    #[error("these factors make {0} runs a person; at most {MOST_RUNS}")]
    TooMany(usize),
}

/// Keys of `motion` that mean something for generated people only, and beside `folders` only.
const OF_GENERATED: [&str; 3] = ["people", "performances", "wrist"];
const OF_RECORDED: [&str; 5] = ["off_model", "match", "group_by", "learn_from", "every"];

type Value<'a> = Spanned<DeValue<'a>>;

/// Factor values, each with the line it stands in.
type Values = Vec<Vec<(String, usize)>>;

struct Reader<'a> {
    plan: &'a str,
    text: &'a str,
    folder: &'a Path,
}

impl Plan {
    /// Reads the text of a plan that is called `plan`; paths in it begin at `folder`.
    pub(super) fn parse(plan: &str, text: &str, folder: &Path) -> Result<Self, PlanError> {
        Reader { plan, text, folder }.plan()
    }

    /// Leaves all but the first link seeds, and the first people, out; the flags that say so: none if nothing is left out.
    pub(super) fn thin(&mut self, seeds: Option<usize>, people: Option<usize>) -> String {
        let mut said = Vec::new();
        let seed = |cell: &Cell| of(&cell.texts, "link_seed").to_owned();
        if let Some(most) = seeds {
            let mut known: Vec<String> = Vec::new();
            for cell in &self.cells {
                let text = seed(cell);
                if text != UNUSED && !known.contains(&text) {
                    known.push(text);
                }
            }
            if most < known.len() {
                said.push(format!("--seeds {most}"));
                known.truncate(most);
                self.cells
                    .retain(|c| seed(c) == UNUSED || known.contains(&seed(c)));
            }
        }
        if let Some(most) = people {
            self.motion.most = Some(most);
            said.push(format!("--people {most}"));
        }
        said.join(" ")
    }

    /// SHA-256 of the text, in hexadecimal digits.
    pub(super) fn hash(&self) -> String {
        sha256(&self.text)
    }
}

/// SHA-256 of a plan's text, in hexadecimal digits.
pub(super) fn sha256(text: &str) -> String {
    hex(&Sha256::digest(text))
}

/// Hexadecimal digits.
pub(super) fn hex(bytes: &[u8]) -> String {
    bytes.iter().map(|byte| format!("{byte:02x}")).collect()
}

impl Reader<'_> {
    fn line(&self, at: usize) -> usize {
        let before = self.text.bytes().take(at);
        1 + before.filter(|byte| *byte == b'\n').count()
    }

    fn wrong(&self, span: Range<usize>, problem: Problem) -> PlanError {
        self.wrong_in(self.line(span.start), problem)
    }

    fn wrong_in(&self, line: usize, problem: Problem) -> PlanError {
        PlanError {
            plan: self.plan.to_owned(),
            line,
            problem,
        }
    }

    fn plan(&self) -> Result<Plan, PlanError> {
        let syntax = |e: toml::de::Error| {
            let problem = Problem::Syntax(e.message().replace('\n', "; "));
            self.wrong(e.span().unwrap_or(0..0), problem)
        };
        let root = DeTable::parse(self.text).map_err(syntax)?;
        let (mut title, mut seed) = (None, 1);
        let mut motion = Motion::default();
        let default = |n: usize| FACTORS[n].default.iter().map(|t| ((*t).to_owned(), 1));
        let mut base: Values = (0..FACTORS.len()).map(|n| default(n).collect()).collect();
        let mut cases = Vec::new();
        // Cases stand on the factors, wherever those are written.
        for (key, value) in root.get_ref() {
            match key.get_ref().as_ref() {
                "title" => title = Some(self.string("title", value)?),
                "seed" => seed = self.whole("seed", value)?,
                "motion" => self.motion(value, &mut motion)?,
                "factors" => self.factors(value, &mut base)?,
                "case" => cases.extend(self.tables(value)?),
                other => {
                    let known = "title, seed, motion, factors, case";
                    return Err(self.unknown(key.span(), other, known));
                }
            }
        }
        let mut crossings = Vec::new();
        for case in cases {
            let mut values = base.clone();
            self.factors(case, &mut values)?;
            crossings.push(values);
        }
        if crossings.is_empty() {
            crossings.push(base);
        }
        Ok(Plan {
            // From wherever it is read, the results are the same.
            title: title.unwrap_or_else(|| {
                let name = Path::new(self.plan).file_name();
                name.map_or_else(String::new, |name| name.to_string_lossy().into_owned())
            }),
            seed,
            motion,
            cells: self.cross(&crossings)?,
            text: self.text.to_owned(),
            folder: self.folder.to_owned(),
        })
    }

    fn motion(&self, value: &Value<'_>, motion: &mut Motion) -> Result<(), PlanError> {
        let table = self.table("motion", value)?;
        let recorded = table.contains_key("folders");
        for (key, value) in table {
            let name = key.get_ref().as_ref();
            let idle = if recorded {
                &OF_GENERATED[..]
            } else {
                &OF_RECORDED
            };
            if idle.contains(&name) {
                let key_of = name.to_owned();
                return Err(self.wrong(
                    key.span(),
                    Problem::Idle {
                        key: key_of,
                        recorded,
                    },
                ));
            }
            match name {
                "people" => motion.people = self.count(name, value, 1)?,
                "performances" => motion.performances = self.count(name, value, 1)? as u32,
                "wrist" | "every" => {
                    let flag = value.get_ref().as_bool();
                    let flag = flag.ok_or_else(|| self.type_of(value, name, "true or false"))?;
                    match name {
                        "wrist" => motion.wrist = flag,
                        _ => motion.every = flag,
                    }
                }
                "folders" => motion.folders = self.folders(name, value)?,
                "off_model" => motion.off_model = self.folders(name, value)?,
                "match" => motion.matching = Some(self.string(name, value)?),
                "group_by" => {
                    let text = self.string(name, value)?;
                    motion.persons = text.parse().map_err(|e| {
                        let why = format!("{e}");
                        self.value(self.line(value.span().start), name, &text, why)
                    })?;
                }
                "learn_from" => motion.learn_from = self.count(name, value, 1)? as usize,
                "axes" => {
                    motion.axes = match self.string(name, value)?.as_str() {
                        "kinect" => Axes::Kinect,
                        "base" => Axes::Base,
                        _ => return Err(self.type_of(value, name, "\"kinect\" or \"base\"")),
                    }
                }
                other => {
                    let known = "people, performances, wrist; or folders, off_model, match, group_by, learn_from, every; and axes";
                    return Err(self.unknown(key.span(), other, known));
                }
            }
        }
        Ok(())
    }

    fn factors(&self, value: &Value<'_>, values: &mut Values) -> Result<(), PlanError> {
        let mut named: Vec<_> = self.table("factors", value)?.iter().collect();
        // What is said of one direction counts, wherever it stands.
        named.sort_by_key(|(key, _)| key.get_ref() != LINK);
        for (key, value) in named {
            let name = key.get_ref().as_ref();
            let mut list = Vec::new();
            match value.get_ref().as_array() {
                Some(array) => {
                    for one in array.iter() {
                        list.push((self.scalar(name, one)?, self.line(one.span().start)));
                    }
                }
                None => list.push((self.scalar(name, value)?, self.line(value.span().start))),
            }
            let list = self.seeds(name, list)?;
            if list.is_empty() {
                return Err(self.wrong(key.span(), Problem::Nothing(name.to_owned())));
            }
            match (index(name), name) {
                (Some(n), _) => values[n] = list,
                (None, LINK) => {
                    for way in ["up", "down"] {
                        values[index(way).expect("a factor")] = list.clone();
                    }
                }
                (None, _) => {
                    let mut known: Vec<_> = FACTORS.iter().map(|f| f.name).collect();
                    known.insert(2, LINK);
                    let problem = Problem::Factor {
                        name: name.to_owned(),
                        known: known.join(", "),
                    };
                    return Err(self.wrong(key.span(), problem));
                }
            }
        }
        Ok(())
    }

    /// `1..10` is ten seeds.
    fn seeds(
        &self,
        name: &str,
        list: Vec<(String, usize)>,
    ) -> Result<Vec<(String, usize)>, PlanError> {
        if name != "link_seed" {
            return Ok(list);
        }
        let mut all = Vec::new();
        for (text, line) in list {
            let Some((from, to)) = text.split_once("..") else {
                all.push((text, line));
                continue;
            };
            let (Ok(from), Ok(to)) = (from.trim().parse::<u64>(), to.trim().parse::<u64>()) else {
                let why = "write the first and the last seed, for example \"1..10\"";
                return Err(self.value(line, name, &text, why.into()));
            };
            if to < from || to - from >= MOST_RUNS as u64 {
                let why = "the last seed comes before the first, or is far away";
                return Err(self.value(line, name, &text, why.into()));
            }
            all.extend((from..=to).map(|seed| (seed.to_string(), line)));
        }
        Ok(all)
    }

    /// Every combination, as its method sees it; each once, in order of first appearance.
    fn cross(&self, crossings: &[Values]) -> Result<Vec<Cell>, PlanError> {
        let (mut cells, mut seen) = (Vec::new(), BTreeSet::new());
        let (up, down) = (index("up"), index("down"));
        let (up, down) = (up.expect("a factor"), down.expect("a factor"));
        for values in crossings {
            // The same list both ways is one link, not every pair of them.
            let paired = values[up] == values[down];
            let lengths: Vec<usize> = (0..FACTORS.len())
                .map(|n| {
                    if paired && n == down {
                        1
                    } else {
                        values[n].len()
                    }
                })
                .collect();
            let total = lengths
                .iter()
                .try_fold(1_usize, |all, n| all.checked_mul(*n))
                .unwrap_or(usize::MAX);
            if total > MOST_RUNS {
                return Err(self.wrong_in(1, Problem::TooMany(total)));
            }
            self.check(values)?;
            for mut rest in 0..total {
                let mut place = [0; FACTORS.len()];
                for n in (0..FACTORS.len()).rev() {
                    place[n] = rest % lengths[n];
                    rest /= lengths[n];
                }
                if paired {
                    place[down] = place[up];
                }
                let texts: Texts = std::array::from_fn(|n| values[n][place[n]].0.clone());
                let method = texts[index("method").expect("a factor")].parse();
                let texts = seen_by(&texts, method.expect("checked above"));
                if seen.insert(texts.clone()) {
                    let settings = Settings::read(&texts, self.folder).expect("checked above");
                    cells.push(Cell { texts, settings });
                }
            }
        }
        Ok(cells)
    }

    /// Every value by itself, so that the line of a wrong one is known.
    fn check(&self, values: &Values) -> Result<(), PlanError> {
        let texts: Texts = std::array::from_fn(|n| FACTORS[n].default[0].to_owned());
        for (n, list) in values.iter().enumerate() {
            for (text, line) in list {
                let mut texts = texts.clone();
                texts[n].clone_from(text);
                Settings::read(&texts, self.folder)
                    .map_err(|why| self.value(*line, FACTORS[n].name, text, why))?;
            }
        }
        Ok(())
    }

    fn scalar(&self, name: &str, value: &Value<'_>) -> Result<String, PlanError> {
        match value.get_ref() {
            DeValue::String(text) => Ok(text.trim().to_owned()),
            DeValue::Integer(number) if number.radix() == 10 => Ok(number.as_str().to_owned()),
            DeValue::Float(number) => Ok(number.as_str().to_owned()),
            DeValue::Boolean(flag) => Ok(flag.to_string()),
            _ => Err(self.type_of(
                value,
                name,
                "a text, a decimal number, true or false, or a list of these",
            )),
        }
    }

    fn string(&self, name: &str, value: &Value<'_>) -> Result<String, PlanError> {
        let text = value.get_ref().as_str();
        text.map(str::to_owned)
            .ok_or_else(|| self.type_of(value, name, "a text"))
    }

    fn whole(&self, name: &str, value: &Value<'_>) -> Result<u64, PlanError> {
        let number = value.get_ref().as_integer();
        number
            .filter(|n| n.radix() == 10)
            .and_then(|n| n.as_str().parse().ok())
            .ok_or_else(|| self.type_of(value, name, "a whole number from 0 on"))
    }

    fn count(&self, name: &str, value: &Value<'_>, least: u64) -> Result<u64, PlanError> {
        let n = self.whole(name, value)?;
        let fits = (least..=10_000).contains(&n);
        fits.then_some(n)
            .ok_or_else(|| self.type_of(value, name, "1 to 10000"))
    }

    fn folders(&self, name: &str, value: &Value<'_>) -> Result<Vec<PathBuf>, PlanError> {
        let list = value.get_ref().as_array();
        let list = list.ok_or_else(|| self.type_of(value, name, "a list of folders"))?;
        let mut folders = Vec::new();
        for one in list.iter() {
            let path = self.folder.join(self.string(name, one)?);
            if !path.is_dir() {
                return Err(self.wrong(one.span(), Problem::Folder(path)));
            }
            folders.push(path);
        }
        Ok(folders)
    }

    fn table<'t, 'i>(
        &self,
        name: &str,
        value: &'t Value<'i>,
    ) -> Result<&'t DeTable<'i>, PlanError> {
        let table = value.get_ref().as_table();
        table.ok_or_else(|| self.type_of(value, name, "a table"))
    }

    fn tables<'t, 'i>(&self, value: &'t Value<'i>) -> Result<Vec<&'t Value<'i>>, PlanError> {
        let list = value.get_ref().as_array();
        let list = list.ok_or_else(|| self.type_of(value, "case", "tables: [[case]]"))?;
        Ok(list.iter().collect())
    }

    fn type_of(&self, value: &Value<'_>, key: &str, what: &'static str) -> PlanError {
        let key = key.to_owned();
        self.wrong(value.span(), Problem::Type { key, what })
    }

    fn unknown(&self, span: Range<usize>, key: &str, known: &str) -> PlanError {
        let (key, known) = (key.to_owned(), known.to_owned());
        self.wrong(span, Problem::Key { key, known })
    }

    fn value(&self, line: usize, factor: &str, text: &str, why: String) -> PlanError {
        let (factor, text) = (factor.to_owned(), text.to_owned());
        self.wrong_in(line, Problem::Value { factor, text, why })
    }
}

#[cfg(test)]
#[path = "plan_tests.rs"]
mod tests;
