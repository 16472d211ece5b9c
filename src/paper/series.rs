//! The publication's own CSV files.

use std::path::Path;

use anyhow::{Context, bail, ensure};
use nalgebra::Vector2;

use super::Series;

/// Reads `ground_truth.csv` and `inferred.csv` of `dir`, and nothing else: what comes out of a codec is
/// computed here, never read.
pub(super) fn read(dir: &Path) -> anyhow::Result<(Series, Series)> {
    let truth = column_pair(&dir.join("ground_truth.csv"))?;
    let inferred = column_pair(&dir.join("inferred.csv"))?;
    ensure!(
        truth.len() == inferred.len(),
        "{}: ground_truth.csv has {} rows and inferred.csv {}; they must be samples of the same instants",
        dir.display(),
        truth.len(),
        inferred.len()
    );
    Ok((truth, inferred))
}

fn column_pair(path: &Path) -> anyhow::Result<Series> {
    let mut reader = csv::ReaderBuilder::new()
        .trim(csv::Trim::All)
        .from_path(path)
        .with_context(|| format!("{}: cannot be read", path.display()))?;
    let header = reader.headers()?.clone();
    ensure!(
        header.iter().eq(["x1", "x2"]),
        "{}:1: the header must be `x1,x2`",
        path.display()
    );
    let mut rows = Vec::new();
    for record in reader.records() {
        let record = record.with_context(|| format!("{}: not a table", path.display()))?;
        let line = record.position().map_or(0, csv::Position::line);
        let number = |field: &str| match field.parse::<f64>() {
            Ok(v) if v.is_finite() => Ok(v),
            _ => bail!(
                "{}:{line}: {field:?} is not a finite number",
                path.display()
            ),
        };
        rows.push(Vector2::new(number(&record[0])?, number(&record[1])?));
    }
    ensure!(
        rows.len() >= 4,
        "{}: {} rows; at least 4 are needed",
        path.display(),
        rows.len()
    );
    Ok(rows)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bad_files_are_named_with_their_line() {
        let dir = tempfile::tempdir().unwrap();
        let message = |truth: &str| {
            std::fs::write(dir.path().join("ground_truth.csv"), truth).unwrap();
            format!("{:#}", read(dir.path()).unwrap_err())
        };
        assert!(message("a,b\n0,0\n").contains("ground_truth.csv:1: the header"));
        assert!(message("x1,x2\n0,0\n1,nan\n").contains("ground_truth.csv:3"));
        assert!(message("x1,x2\n0,0\n1\n").contains("ground_truth.csv"));
        assert!(message("x1,x2\n0,0\n").contains("1 rows"));
        assert!(message("x1,x2\n0,0\n1,1\n2,2\n3,3\n").contains("inferred.csv"));
        let other = "x1,x2\n0,0\n1,1\n2,2\n3,3\n4,4\n";
        std::fs::write(dir.path().join("inferred.csv"), other).unwrap();
        assert!(message("x1,x2\n0,0\n1,1\n2,2\n3,3\n").contains("4 rows"));
    }
}
