//! scratch
use std::io::Write;
fn main() {
    let n: u64 = std::env::args().nth(1).unwrap().parse().unwrap();
    let dir = std::env::args().nth(2).unwrap();
    for s in 0..n {
        for i in 0..6u32 {
            let mut f = std::io::BufWriter::new(
                std::fs::File::create(format!("{dir}/a_s{s}_t{i}.csv")).unwrap(),
            );
            writeln!(f, "t,x,y,z").unwrap();
            for (t, x) in telemime_sim::hand::swing(s, i) {
                writeln!(f, "{t:.6},{:.6},{:.6},{:.6}", x[0], x[1], x[2]).unwrap();
            }
        }
    }
}
