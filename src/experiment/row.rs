//! One line of the results.

use super::factor::{FACTORS, Texts};
use super::figures::Figures;

/// What became of one run.
#[derive(Debug, Clone, PartialEq)]
pub(super) struct Row {
    /// Its place in the plan's list, from 1 on.
    pub(super) run: usize,
    /// Of its settings, the subject and the plan's seed: the same run of a longer plan keeps it.
    pub(super) id: String,
    pub(super) subject: String,
    pub(super) person: String,
    /// Where it ran; what is computed ran on the virtual one.
    pub(super) ground: String,
    pub(super) texts: Texts,
    /// `followed`, `stopped: WHY` or `not driven: WHY`.
    pub(super) outcome: String,
    pub(super) figures: Figures,
}

/// Columns before the factors, and after them before the figures.
const BEFORE: [&str; 5] = ["run", "id", "subject", "person", "ground"];
const AFTER: &str = "outcome";

impl Row {
    /// The names of the columns.
    pub(super) fn header() -> Vec<&'static str> {
        let factors = FACTORS.iter().map(|f| f.name);
        let before = BEFORE.into_iter().chain(factors);
        let figures = Figures::NAMES.iter().copied();
        before.chain([AFTER]).chain(figures).collect()
    }

    /// The values, in the columns' order; numbers as short as they can be read back from.
    pub(super) fn fields(&self) -> Vec<String> {
        let mut fields = vec![
            self.run.to_string(),
            self.id.clone(),
            self.subject.clone(),
            self.person.clone(),
            self.ground.clone(),
        ];
        fields.extend(self.texts.iter().cloned());
        fields.push(self.outcome.clone());
        let figures = self.figures.values().into_iter();
        let text = |v: f64| v.is_finite().then(|| v.to_string());
        fields.extend(figures.map(|value| value.and_then(text).unwrap_or_default()));
        fields
    }

    /// The row that has these fields; `None` if they are not a row's.
    pub(super) fn from_fields<'a>(fields: impl IntoIterator<Item = &'a str>) -> Option<Self> {
        let fields: Vec<&str> = fields.into_iter().collect();
        if fields.len() != Self::header().len() {
            return None;
        }
        let (head, rest) = fields.split_at(BEFORE.len());
        let (factors, rest) = rest.split_at(FACTORS.len());
        let values: Vec<Option<f64>> = rest[1..]
            .iter()
            .map(|text| match *text {
                "" => Some(None),
                text => text.parse().ok().filter(|v: &f64| v.is_finite()).map(Some),
            })
            .collect::<Option<_>>()?;
        Some(Self {
            run: head[0].parse().ok()?,
            id: head[1].to_owned(),
            subject: head[2].to_owned(),
            person: head[3].to_owned(),
            ground: head[4].to_owned(),
            texts: std::array::from_fn(|n| factors[n].to_owned()),
            outcome: rest[0].to_owned(),
            figures: Figures::from_values(values),
        })
    }

    /// As one line of CSV, its end included.
    pub(super) fn line(&self) -> Vec<u8> {
        line(self.fields())
    }
}

/// One line of CSV, its end included.
pub(super) fn line<T: AsRef<[u8]>>(fields: impl IntoIterator<Item = T>) -> Vec<u8> {
    let mut out = csv::Writer::from_writer(Vec::new());
    let written = out.write_record(fields);
    written.expect("memory takes what is written");
    out.into_inner().expect("memory takes what is written")
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_row_is_read_as_it_was_written() {
        let row = Row {
            run: 3,
            id: "0123456789ab".into(),
            subject: "swing, \"left\"".into(),
            person: "7".into(),
            ground: "loopback".into(),
            texts: std::array::from_fn(|n| FACTORS[n].default[0].to_owned()),
            outcome: "stopped: LeaseOver".into(),
            figures: Figures {
                rmse_m: Some(0.1 + 0.2),
                clamps: Some(0.0),
                lag_s: Some(-1e-300),
                ..Figures::default()
            },
        };
        let line = row.line();
        assert_eq!(line.iter().filter(|byte| **byte == b'\n').count(), 1);
        let mut reader = csv::ReaderBuilder::new()
            .has_headers(false)
            .from_reader(&line[..]);
        let record = reader.records().next().unwrap().unwrap();
        assert_eq!(Row::from_fields(&record), Some(row.clone()));
        assert_eq!(Row::from_fields(["1", "2"]), None);
        let mut endless = row.fields();
        *endless.last_mut().unwrap() = "1e999".into();
        assert_eq!(Row::from_fields(endless.iter().map(String::as_str)), None);
    }
}
