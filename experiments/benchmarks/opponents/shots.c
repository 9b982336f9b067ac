/* The cost of simulated flights of the published model, Eqs. (1)-(9), by forward Euler. */
#include <math.h>

#define STATES 12
#define PARAMETERS 8

/* forcing: (steps, 4). measured: (steps + 1, 12). Sums from sample `begin` on. */
static double cost_of_one(int steps, int begin, double dt, double gravity, const double *forcing,
                          const double *measured, const double *weights, const double *first, const double *a)
{
    double s[STATES], sum = 0.0;
    for (int i = 0; i < STATES; i++)
        s[i] = first[i];
    for (int k = 0; k <= steps; k++) {
        if (k >= begin)
            for (int i = 0; i < STATES; i++) {
                double error = weights[i] * (measured[k * STATES + i] - s[i]);
                sum += error * error;
            }
        if (k == steps)
            break;
        const double *u = forcing + 4 * k;
        double vx = s[1], vy = s[3], vz = s[5], p = s[7], q = s[9], r = s[11];
        double sphi = sin(s[6]), cphi = cos(s[6]), sth = sin(s[8]), cth = cos(s[8]), spsi = sin(s[10]), cpsi = cos(s[10]);
        double turning = q * sphi + r * cphi;
        s[0] += dt * vx;
        s[1] += dt * (sphi * cpsi - spsi * sth * cphi) * u[3];
        s[2] += dt * vy;
        s[3] += dt * (-spsi * sphi - sth * cphi * cpsi) * u[3];
        s[4] += dt * vz;
        s[5] += dt * (cth * cphi * u[3] - gravity);
        s[6] += dt * (p + sth / cth * turning);
        s[7] += dt * (q * r * a[0] - a[1] * q + a[2] * u[0]);
        s[8] += dt * (q * cphi - r * sphi);
        s[9] += dt * (p * r * a[3] + r * a[4] + a[5] * u[1]);
        s[10] += dt * turning / cth;
        s[11] += dt * (p * q * a[6] + a[7] * u[2]);
    }
    return 0.5 * sum;
}

void shots(int flights, int steps, int begin, double dt, double gravity, const double *forcing,
           const double *measured, const double *weights, const double *first, const double *alphas, double *costs)
{
    for (int i = 0; i < flights; i++)
        costs[i] = cost_of_one(steps, begin, dt, gravity, forcing, measured + (long)i * (steps + 1) * STATES, weights,
                               first + i * STATES, alphas + i * PARAMETERS);
}
